"""Where rays from a point inside an outline leave it: the outline of a matte, and that of a projected mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def directions(count: int) -> Array:
    """Unit vectors [R,2] in pixels (y down), evenly spread."""
    angle = (np.arange(count) + 0.5) * (2 * np.pi / count)
    return np.stack((np.cos(angle), np.sin(angle)), -1)


def first_exits(matte: NDArray[np.float32], inside: NDArray[np.float32], centre: Array, rays: Array) -> Array:
    """Distances [R] in pixels at which rays first leave a matte; NaN where they start beside it or leave the photo.

    A ray that starts outside the photo counts from where it enters that.

    Args:
        matte: [S,S] in [0,1].
        inside: [S,S] how far each pixel lies in the photo.
        centre: [2] pixels.
        rays: [R,2] unit vectors.
    """
    from scipy.ndimage import map_coordinates

    size = matte.shape[0]
    steps = np.arange(0.0, 1.5 * size, 0.5)
    points = centre + steps[:, None, None] * rays  # [P,R,2]
    rows, columns = points[..., 1] - 0.5, points[..., 0] - 0.5
    value = map_coordinates(matte, (rows, columns), order=1, mode="nearest")
    shown = map_coordinates(inside, (rows, columns), order=1, mode="constant") > 0.99
    at = np.arange(len(rays))
    entry = shown.argmax(0)
    out = (value < 0.5) & (np.arange(len(steps))[:, None] >= entry)
    first = out.argmax(0)
    good = out.any(0) & (first > entry)
    # One step further the photo has to be there still: its own edge is no outline.
    good &= shown[(first + 2).clip(max=len(steps) - 1), at]
    before, after = value[first - 1, at], value[first, at]
    exact = steps[first] - 0.5 * (0.5 - after) / np.maximum(before - after, 1e-6)
    return np.where(good, exact, np.nan)


def far_crossings(pixels: Array, edges: NDArray[np.int64], centre: Array, rays: Array) -> tuple[Array, Array, Array]:
    """The last edge of a mesh that each ray crosses.

    Args:
        pixels: [V,2] vertices.
        edges: [E,2] vertex ids.
        centre: [2] pixels.
        rays: [R,2] unit vectors.

    Returns:
        Distances [R] in pixels (0 where no edge is crossed), edges [R], and how far from its first vertex to its
        second each is crossed [R], in [0,1].
    """
    points = pixels - centre
    aside = rays[:, :1] * points[:, 1] - rays[:, 1:] * points[:, 0]  # [R,V] signed distance from the ray's line
    along = rays @ points.T
    a, b = edges.T
    left, right = aside[:, a], aside[:, b]
    crossing = (left > 0) != (right > 0)
    share = np.where(crossing, left / np.where(crossing, left - right, 1.0), 0.0)
    distance = np.where(crossing, along[:, a] + share * (along[:, b] - along[:, a]), 0.0)
    last = distance.argmax(1)
    at = np.arange(len(rays))
    return distance[at, last], last, share[at, last]


def same_crossings(pixels: Array, ends: NDArray[np.int64], centre: Array, rays: Array) -> Array:
    """Distances [R] in pixels at which rays cross the lines of given edges [R,2] of a mesh that has moved a little."""
    points = pixels[ends] - centre  # [R,2,2]
    aside = rays[:, :1] * points[..., 1] - rays[:, 1:] * points[..., 0]
    along = (points * rays[:, None]).sum(-1)
    width = aside[:, 0] - aside[:, 1]
    share = aside[:, 0] / np.where(np.abs(width) > 1e-9, width, 1e-9)
    return along[:, 0] + share * (along[:, 1] - along[:, 0])
