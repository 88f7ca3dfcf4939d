"""The face and person models behind plain functions; their weights come with the package and no network is used."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

_MASK_SIDE = 256  # pixels that the person model sees


def face_boxes(images: Sequence[NDArray[np.uint8]]) -> list[list[tuple[float, ...]]]:
    """Boxes (x0, y0, width, height) in pixels of every face in each image [H,W,3], by both detector ranges."""
    from uika.photo.face_detector import RANGES, detect_faces

    return [
        [
            (float(x0), float(y0), float(x1 - x0), float(y1 - y0))
            for reach in RANGES
            for (x0, y0, x1, y1), _, _ in detect_faces(image, reach)
        ]
        for image in images
    ]


def face_scores(images: Sequence[NDArray[np.uint8]]) -> list[float]:
    """How sure the two detector ranges are of the best face in each image [H,W,3], summed: 0 (no face) to 2."""
    from uika.photo.face_detector import RANGES, detect_faces

    return [
        sum(max((face.score for face in detect_faces(image, reach)), default=0.0) for reach in RANGES)
        for image in images
    ]


def face_meshes(images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.float64] | None]:
    """Landmarks [478,2] in pixels of the largest face in each image [H,W,3]; None where there is none."""
    from uika.photo import face_mesh

    found = (face_mesh.face_meshes(image) for image in images)
    return [max(faces, key=lambda face: float(np.ptp(face, axis=0).prod()), default=None) for faces in found]


def follow_meshes(
    images: Iterable[NDArray[np.uint8]],
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float64] | None]]:
    """Each image [H,W,3] of a video with the landmarks [478,2] in pixels of its face, or None where there is none.

    Faster and steadier than `face_meshes`, because a face is looked for where it was in the image before.
    """
    from uika.photo.face_mesh import follow_mesh

    return follow_mesh(images)


def person_mask(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rough probability [H,W] in [0,1] that a pixel of image [H,W,3] belongs to a person."""
    import torch

    from uika.photo.regions_of_interest import Region, sampled
    from uika.photo.tflite import run

    height, width = image.shape[:2]
    seen = sampled(image, Region(width / 2, height / 2, width, height, 0.0), _MASK_SIDE, border=False)
    mask = torch.from_numpy(run("selfie", seen)[0][0, ..., 0])[None, None]
    whole = torch.nn.functional.interpolate(mask, (height, width), mode="bilinear", align_corners=False)
    return whole[0, 0].clamp(0, 1).numpy()
