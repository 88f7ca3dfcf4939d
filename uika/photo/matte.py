"""Soft person matte: a rough segmentation turned into a trimap and solved by closed-form matting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uika.photo.closed_form import solve_alpha

MAX_SOLVE = 512  # side in pixels above which the matte is solved smaller and enlarged
MAX_FREE = 80_000  # free pixels above which it is solved smaller still: the factorisation would take many seconds
SURE_INSIDE, SURE_OUTSIDE = 0.9, 0.1
INSIDE_BAND, OUTSIDE_BAND = 0.02, 0.035  # of the crop side; the outer band is wider because hair strands lie outside
MIN_ALPHA, MAX_ALPHA = 0.02, 0.98  # solver residue beyond these is rounded to nothing or to everything


def trimap(rough: NDArray[np.float32], sure: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Trimap [S,S] (0 background, 0.5 unknown, 1 person) from a rough mask [S,S] and pixels [S,S] surely of the person.

    Only the part of the mask connected to the sure pixels counts, so other people in the crop are background.
    """
    from scipy import ndimage

    size = rough.shape[0]
    parts, _ = ndimage.label((rough > SURE_OUTSIDE) | sure)
    person = np.isin(parts, np.unique(parts[sure]))
    inside = ndimage.binary_fill_holes(person & (rough > SURE_INSIDE)) | sure
    far_inside = ndimage.distance_transform_edt(np.pad(inside, 1, mode="edge"))[1:-1, 1:-1] > INSIDE_BAND * size
    far_outside = ndimage.distance_transform_edt(np.pad(~person, 1, mode="edge"))[1:-1, 1:-1] > OUTSIDE_BAND * size
    result = np.full(rough.shape, 0.5)
    result[far_outside] = 0.0
    result[far_inside | sure] = 1.0
    return result


def solve(image: NDArray[np.uint8], known: NDArray[np.float64]) -> NDArray[np.float32]:
    """Matte [S,S] in [0,1] of image [S,S,3] that agrees with the trimap `known` [S,S].

    Large crops, and those with much to decide, are solved smaller and enlarged.
    """
    size = known.shape[0]
    free = float((known == 0.5).mean())
    small = min(size, MAX_SOLVE, round((MAX_FREE / max(free, 1e-6)) ** 0.5))
    pixels = _resize(image, small) / 255.0
    levels = known if small == size else np.round(2 * _resize(known.astype(np.float32), small)) / 2
    if not ((levels == 0).any() and (levels == 1).any() and (levels == 0.5).any()):
        return known.astype(np.float32)
    alpha = solve_alpha(pixels, levels)
    alpha = ((alpha - MIN_ALPHA) / (MAX_ALPHA - MIN_ALPHA)).clip(0, 1).astype(np.float32)
    return _resize(alpha, size).clip(0, 1)


def _resize(image: NDArray, size: int) -> NDArray:
    from PIL import Image

    if image.shape[0] == size:
        return image
    return np.asarray(Image.fromarray(image).resize((size, size), Image.Resampling.BICUBIC))
