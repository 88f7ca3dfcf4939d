"""The 478 landmarks of a face by MediaPipe's face mesh with attention (Grishchenko et al. 2020).

A first network sees the face and places 468 points. Crops of its features around lips and eyes, levelled and of one
size, go to a second one, which places the points of these parts again and those of the irises.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uika.assets import FACE_MODELS
from uika.photo.face_detector import Detection, detect_faces
from uika.photo.regions_of_interest import Region, face_region, overlap, sampled
from uika.photo.tflite import run

SIDE = 192  # pixels that the first network sees
STRIDE = 4  # of its features
MESH_POINTS, FIRST_IRIS, IRIS_POINTS = 468, 468, 5
EYE_CORNERS = (33, 263)
PRESENT = 0.5  # probability from which there is a face
SAME_FACE = 0.5  # intersection over union of two regions that show one face
LEAST_SIDE = 1.0  # pixels; a smaller region shows nothing


class _Part(NamedTuple):
    """Lips or an eye."""

    corners: tuple[int, int]  # landmarks that shall lie level
    landmarks: NDArray[np.int64]  # which the second network places, in its order
    scale: float  # side of the crop over the landmarks' box
    size: int  # of the crop in features


@lru_cache(maxsize=1)
def _parts() -> tuple[_Part, ...]:
    known = json.loads((FACE_MODELS / "mesh_parts.json").read_text(encoding="utf-8"))
    return tuple(
        _Part((part["corners"][0], part["corners"][1]), np.array(part["landmarks"]), part["scale"], part["size"])
        for part in known
    )


def face_mesh(image: NDArray[np.uint8], region: Region) -> NDArray[np.float64] | None:
    """Landmarks [478,2] in pixels of an image [H,W,3] of the face in a region; None if there is none."""
    mesh, features, flag = run("mesh", sampled(image, region, SIDE))
    if 1 / (1 + math.exp(-float(flag.item()))) <= PRESENT:
        return None
    points = np.empty((MESH_POINTS + 2 * IRIS_POINTS, 2))
    points[:MESH_POINTS] = mesh.reshape(-1, 3)[:, :2]
    transforms = [_transform(points / STRIDE, part) for part in _parts()]
    crops = [_crop(features[0], *transform, part.size) for transform, part in zip(transforms, _parts(), strict=True)]
    lips, left_eye, left_iris, right_eye, right_iris = run("mesh_parts", *crops)
    irises = FIRST_IRIS + np.arange(2 * IRIS_POINTS).reshape(2, IRIS_POINTS)
    for part, index, placed in (
        (0, _parts()[0].landmarks, lips),
        (1, _parts()[1].landmarks, left_eye),
        (2, _parts()[2].landmarks, right_eye),
        (1, irises[0], left_iris),
        (2, irises[1], right_iris),
    ):
        matrix, shift = transforms[part]
        # Of the crop's places to those of the picture: features lie STRIDE pixels apart, and so do the answers.
        points[index] = placed.reshape(-1, 2) @ matrix.T + STRIDE * shift
    return region.points(points / SIDE)


def face_meshes(image: NDArray[np.uint8], most: int = 4) -> list[NDArray[np.float64]]:
    """Landmarks [478,2] in pixels of up to `most` faces in an image [H,W,3]."""
    regions: list[Region] = []
    for detection in detect_faces(image, "short")[:most]:
        region = _detected(detection)
        regions = [other for other in regions if overlap(other, region) <= SAME_FACE] + [region]
    found = (face_mesh(image, region) for region in regions if region.width >= LEAST_SIDE)
    return [mesh for mesh in found if mesh is not None]


def follow_mesh(
    images: Iterable[NDArray[np.uint8]],
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float64] | None]]:
    """Each image of a video with its face's landmarks [478,2] or None; looked for where the face was before."""
    region: Region | None = None
    for image in images:
        if region is None:
            region = next((_detected(detection) for detection in detect_faces(image, "short")[:1]), None)
        mesh = None if region is None or region.width < LEAST_SIDE else face_mesh(image, region)
        region = None
        if mesh is not None:
            box = np.concatenate((mesh.min(0), mesh.max(0)))
            region = face_region(box, mesh[EYE_CORNERS[0]], mesh[EYE_CORNERS[1]])
        yield image, mesh


def _detected(detection: Detection) -> Region:
    return face_region(detection.box, *detection.eyes)


def _transform(points: NDArray[np.float64], part: _Part) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix [2,2] and shift [2] from places in a part's crop to places in the features; `points` lie there."""
    first, second = points[list(part.corners)]
    angle = math.atan2(second[1] - first[1], second[0] - first[0])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    level = points[part.landmarks] @ turn
    low, high = level.min(0), level.max(0)
    matrix = turn * (part.scale * (high - low) / part.size)
    return matrix, turn @ ((low + high) / 2) - matrix @ np.full(2, part.size / 2)


def _crop(
    features: NDArray[np.float32], matrix: NDArray[np.float64], shift: NDArray[np.float64], size: int
) -> NDArray[np.float32]:
    """Features [1,size,size,C] at the crop's places, bilinear, 0 beyond the features [H,W,C]."""
    height, width = features.shape[:2]
    centres = np.arange(size) + 0.5
    place = np.stack(np.meshgrid(centres, centres), -1) @ matrix.T + shift - 0.5
    inside = np.asarray(((place >= 0) & (place <= (width - 1, height - 1))).all(-1))
    cell = np.floor(place).astype(np.int64)
    x, y = (place - cell).astype(np.float32).transpose(2, 0, 1)[..., None]
    column, row = cell[..., 0].clip(0, width - 1), cell[..., 1].clip(0, height - 1)
    right, below = (column + 1).clip(max=width - 1), (row + 1).clip(max=height - 1)
    upper = (1 - x) * features[row, column] + x * features[row, right]
    lower = (1 - x) * features[below, column] + x * features[below, right]
    return (((1 - y) * upper + y * lower) * inside[..., None]).astype(np.float32)[None]
