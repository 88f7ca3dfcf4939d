"""Faces in a picture by MediaPipe's two detectors (Bazarevsky et al. 2019, BlazeFace)."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uika.photo.regions_of_interest import Region, sampled
from uika.photo.tflite import run

Range = Literal["short", "full"]
RANGES: tuple[Range, ...] = ("full", "short")
_SIZES = {"short": 128, "full": 192}  # pixels that a detector sees
_CELLS = {"short": ((16, 2), (8, 6)), "full": ((48, 1),)}  # cells along a side, and guesses in each
_SURE = {"short": 0.5, "full": 0.6}  # score from which a guess counts
_SUPPRESSED = 0.3  # intersection over union from which two guesses mean one face
_SCORE_LIMIT = 100.0


class Detection(NamedTuple):
    """A face in pixels of the picture."""

    box: NDArray[np.float64]  # [4] x0, y0, x1, y1
    eyes: NDArray[np.float64]  # [2,2] the subject's right eye, then the left
    score: float


def detect_faces(image: NDArray[np.uint8], reach: Range) -> list[Detection]:
    """Faces in an image [H,W,3], the surest first; "short" is for faces near the camera, "full" for
    small ones too."""
    size = _SIZES[reach]
    height, width = image.shape[:2]
    side = max(height, width)
    region = Region(width / 2, height / 2, side, side, 0.0)
    guesses, scores = run(f"detection_{reach}", sampled(image, region, size, -1.0, border=False))
    score = 1 / (1 + np.exp(-scores[0, :, 0].astype(np.float64).clip(-_SCORE_LIMIT, _SCORE_LIMIT)))
    # MediaPipe numbers detections as the network does and takes the first of equals.
    chosen = np.flatnonzero(score >= _SURE[reach])
    values = guesses[0, chosen].astype(np.float64) / size
    anchors = _anchors(reach)[chosen]
    centre, half = values[:, :2] + anchors, values[:, 2:4] / 2
    eyes = values[:, 4:8].reshape(-1, 2, 2) + anchors[:, None]
    rows = np.concatenate((centre - half, centre + half, eyes.reshape(-1, 4)), -1)
    kept = _merged(rows, score[chosen])
    points = [(region.points(row.reshape(4, 2)), value) for row, value in kept]
    return [Detection(place[:2].reshape(4), place[2:], value) for place, value in points]


@lru_cache(maxsize=2)
def _anchors(reach: Range) -> NDArray[np.float64]:
    """Centres [N,2] that a detector's guesses are relative to, 0 to 1 along the picture's sides."""
    layers = []
    for cells, guesses in _CELLS[reach]:
        middle = (np.arange(cells) + 0.5) / cells
        grid = np.stack(np.meshgrid(middle, middle), -1).reshape(-1, 2)
        layers.append(grid.repeat(guesses, axis=0))
    return np.concatenate(layers)


def _merged(rows: NDArray[np.float64], scores: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], float]]:
    """Guesses [N,8] (box, then points) that mean one face as their mean by score, with the best score of each."""
    left = np.argsort(-scores, kind="stable")
    result = []
    while len(left):
        best = left[0]
        similar = _overlaps(rows[left, :4], rows[best, :4]) > _SUPPRESSED
        group = left[similar]
        result.append(((rows[group] * scores[group, None]).sum(0) / scores[group].sum(), float(scores[best])))
        left = left[~similar]
        if not similar.any():  # a box without area overlaps nothing, itself included
            break
    return result


def _overlaps(boxes: NDArray[np.float64], box: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersection over union [N] of boxes [N,4] with one."""
    low, high = np.maximum(boxes[:, :2], box[:2]), np.minimum(boxes[:, 2:], box[2:])
    shared = (high - low).clip(0).prod(-1)
    area = (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(-1) + (box[2:] - box[:2]).clip(0).prod() - shared
    return np.where(area > 0, shared / np.maximum(area, 1e-30), 0.0)
