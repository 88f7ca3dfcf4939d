"""Square crops that may reach outside the photo, resampled with antialiasing."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Square = tuple[float, float, float]  # x0, y0, side in pixels of the photo


def resample(photo: NDArray[np.uint8], square: Square, size: int) -> NDArray[np.uint8]:
    """Crop [size,size(,3)] of a photo [H,W(,3)]; beyond the photo its edge pixels are repeated."""
    from PIL import Image

    x0, y0, side = square
    margin = math.ceil(2 * max(side / size, 1.0)) + 1  # reach of the bicubic kernel
    left, top = math.floor(x0) - margin, math.floor(y0) - margin
    rows = np.arange(top, math.ceil(y0 + side) + margin).clip(0, photo.shape[0] - 1)
    columns = np.arange(left, math.ceil(x0 + side) + margin).clip(0, photo.shape[1] - 1)
    region = Image.fromarray(np.ascontiguousarray(photo[rows[:, None], columns]))
    box = (x0 - left, y0 - top, x0 - left + side, y0 - top + side)
    return np.asarray(region.resize((size, size), Image.Resampling.BICUBIC, box))


def coverage(photo_size: tuple[int, int], square: Square, size: int) -> NDArray[np.float32]:
    """Share [size,size] of each crop pixel that lies inside a photo of (height, width)."""
    height, width = photo_size
    x0, y0, side = square
    edges = np.arange(size + 1) * (side / size)

    def inside(start: float, length: int) -> NDArray[np.float64]:
        return np.diff(np.clip(start + edges, 0, length)) * (size / side)

    return np.outer(inside(y0, height), inside(x0, width)).astype(np.float32)


def pixel_centres(size: int) -> NDArray[np.float64]:
    """Coordinates [size,size,2] of the pixel centres of a square crop."""
    centres = np.arange(size) + 0.5
    return np.stack(np.meshgrid(centres, centres), axis=-1)


def to_crop(points: NDArray[np.float64], square: Square, size: int) -> NDArray[np.float64]:
    """Photo pixel coordinates [...,2] to crop pixel coordinates."""
    return (points - np.array(square[:2])) * (size / square[2])


def to_photo(points: NDArray[np.float64], square: Square, size: int) -> NDArray[np.float64]:
    """Crop pixel coordinates [...,2] to photo pixel coordinates."""
    return points * (square[2] / size) + np.array(square[:2])
