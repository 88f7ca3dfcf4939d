"""Turned rectangles of a picture as the face models see them: MediaPipe's arithmetic, to the last grey level."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_FRACTIONS = 32  # places between two pixels that samples are taken at, as OpenCV's fixed-point warp does
_ENLARGED = 1.5  # side of a face's region over the longer side of its box


class Region(NamedTuple):
    """A rectangle in pixels (centres at +0.5), turned clockwise by `angle` radians."""

    x: float  # centre
    y: float
    width: float
    height: float
    angle: float

    def points(self, relative: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places [...,2] in the rectangle, 0 to 1 along its sides, as pixels of the picture."""
        across, down = ((relative - 0.5) * (self.width, self.height)).T
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return np.stack((cos * across - sin * down + self.x, sin * across + cos * down + self.y), -1)


def face_region(box: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64]) -> Region:
    """The square around a face: its box (x0, y0, x1, y1) enlarged and turned so that two points [2] lie level."""
    side = _ENLARGED * float(max(box[2] - box[0], box[3] - box[1]))
    angle = math.atan2(second[1] - first[1], second[0] - first[0])
    return Region(float(box[0] + box[2]) / 2, float(box[1] + box[3]) / 2, side, side, angle)


def overlap(one: Region, other: Region) -> float:
    """Intersection over union of two regions as if they were not turned."""
    sides = [
        min(a + s / 2, b + t / 2) - max(a - s / 2, b - t / 2)
        for a, s, b, t in ((one.x, one.width, other.x, other.width), (one.y, one.height, other.y, other.height))
    ]
    shared = max(sides[0], 0.0) * max(sides[1], 0.0)
    return shared / max(one.width * one.height + other.width * other.height - shared, 1e-9)


def sampled(
    image: NDArray[np.uint8], region: Region, size: int, low: float = 0.0, *, border: bool = True
) -> NDArray[np.float32]:
    """The region as [1,size,size,3] with grey levels from `low` to 1.

    Args:
        image: [H,W,3].
        region: what to show.
        size: of the result in pixels.
        low: what black becomes.
        border: whether the picture's edge is repeated beyond it; else black lies there.
    """
    cos, sin = math.cos(region.angle), math.sin(region.angle)
    place = np.arange(size) / size - 0.5
    across, down = region.width * place, (region.height * place)[:, None]
    x = np.rint((cos * across - sin * down + region.x) * _FRACTIONS).astype(np.int64)
    y = np.rint((sin * across + cos * down + region.y) * _FRACTIONS).astype(np.int64)
    column, row, right, below = x // _FRACTIONS, y // _FRACTIONS, x % _FRACTIONS, y % _FRACTIONS
    total = np.zeros((size, size, 3), dtype=np.int64)
    height, width = image.shape[:2]
    for step_y, weight_y in ((0, _FRACTIONS - below), (1, below)):
        for step_x, weight_x in ((0, _FRACTIONS - right), (1, right)):
            at_row, at_column = row + step_y, column + step_x
            weight = weight_x * weight_y
            if not border:
                weight = weight * ((at_row >= 0) & (at_row < height) & (at_column >= 0) & (at_column < width))
            pixels = image[at_row.clip(0, height - 1), at_column.clip(0, width - 1)]
            total += weight[..., None] * pixels.astype(np.int64)
    levels = (total + _FRACTIONS**2 // 2) // _FRACTIONS**2
    return (levels * ((1 - low) / 255) + low).astype(np.float32)[None]
