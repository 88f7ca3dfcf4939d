"""The three mediapipe models behind plain functions. Their weights lie in the mediapipe wheel: no network is used."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STDERR_LOCK = threading.RLock()


def face_boxes(images: Sequence[NDArray[np.uint8]], confidence: float = 0.5) -> list[list[tuple[float, ...]]]:
    """Boxes (x0, y0, width, height) in pixels of every face in each image [H,W,3], by both detector ranges."""
    found: list[list[tuple[float, ...]]] = [[] for _ in images]
    with _solutions() as solutions:
        for model in (1, 0):
            with solutions.face_detection.FaceDetection(confidence, model_selection=model) as detector:
                for boxes, image in zip(found, images, strict=True):
                    height, width = image.shape[:2]
                    for detection in detector.process(image).detections or ():
                        box = detection.location_data.relative_bounding_box
                        boxes.append((box.xmin * width, box.ymin * height, box.width * width, box.height * height))
    return found


def face_scores(images: Sequence[NDArray[np.uint8]]) -> list[float]:
    """How sure the two detector ranges are of the best face in each image [H,W,3], summed: 0 (no face) to 2."""
    found = np.zeros(len(images))
    with _solutions() as solutions:
        for model in (1, 0):
            with solutions.face_detection.FaceDetection(model_selection=model) as detector:
                for index, image in enumerate(images):
                    scores = [detection.score[0] for detection in detector.process(image).detections or ()]
                    found[index] += max(scores, default=0.0)
    return [float(score) for score in found]


def face_meshes(images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.float64] | None]:
    """Landmarks [478,2] in pixels of the largest face in each image [H,W,3]; None where there is none."""
    found: list[NDArray[np.float64] | None] = []
    with (
        _solutions() as solutions,
        solutions.face_mesh.FaceMesh(static_image_mode=True, refine_landmarks=True, max_num_faces=4) as mesh,
    ):
        for image in images:
            size = np.array(image.shape[1::-1], dtype=np.float64)
            faces = [
                np.array([(point.x, point.y) for point in face.landmark]) * size
                for face in mesh.process(image).multi_face_landmarks or ()
            ]
            found.append(max(faces, key=lambda face: float(np.ptp(face, axis=0).prod()), default=None))
    return found


def follow_meshes(
    images: Iterable[NDArray[np.uint8]],
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float64] | None]]:
    """Each image [H,W,3] of a video with the landmarks [478,2] in pixels of its face, or None where there is none.

    Faster and steadier than `face_meshes`, because a face is looked for where it was in the image before.
    """
    with _solutions() as solutions:
        mesh = solutions.face_mesh.FaceMesh(refine_landmarks=True, max_num_faces=1)
        mesh.process(np.zeros((64, 64, 3), dtype=np.uint8))  # whatever it logs, it logs at the first image
    with mesh:
        for image in images:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = mesh.process(image).multi_face_landmarks
            size = np.array(image.shape[1::-1], dtype=np.float64)
            yield image, np.array([(point.x, point.y) for point in found[0].landmark]) * size if found else None


def person_mask(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rough probability [H,W] in [0,1] that a pixel of image [H,W,3] belongs to a person."""
    with _solutions() as solutions, solutions.selfie_segmentation.SelfieSegmentation(model_selection=0) as model:
        return np.clip(model.process(image).segmentation_mask, 0.0, 1.0).astype(np.float32)


@contextmanager
def _solutions() -> Iterator[Any]:
    """`mediapipe.solutions`, imported on first use, with its warnings and its native log lines kept off stderr."""
    with warnings.catch_warnings(), _native_stderr_closed():
        warnings.simplefilter("ignore")  # protobuf 4 deprecates calls that this mediapipe makes
        try:
            import mediapipe
        except ImportError as error:
            raise ImportError("reading photos needs mediapipe: pip install 'uika-drjit[photo]'") from error
        yield mediapipe.solutions


@contextmanager
def _native_stderr_closed() -> Iterator[None]:
    """Point file descriptor 2 at the null device: TFLite and absl log there, and no variable or call stops them."""
    with _STDERR_LOCK:
        try:
            saved = os.dup(2)
        except OSError:  # a process without stderr has nothing to silence
            yield
            return
        try:
            with open(os.devnull, "wb") as null:  # noqa: PTH123
                os.dup2(null.fileno(), 2)
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
