"""Closed-form matting (Levin, Lischinski and Weiss 2008) in numpy and scipy: nothing is compiled at first use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EPSILON = 1e-6  # regularises the colour covariance of a window; the images are in [0,1]
TIE = 1e-10  # pull of every free pixel towards 0, far below the Laplacian's own weights
Stencil = dict[tuple[int, int], NDArray[np.float64]]
OFFSETS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]  # pixels of a window


def solve_alpha(image: NDArray[np.float64], known: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matte [H,W] of image [H,W,3] that keeps `known` [H,W] where it is 0 or 1 and is free where it is 0.5.

    Minimises alpha' L alpha (their equation 11) exactly, with a sparse factorisation of L's free block.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    height, width = known.shape
    free = known == 0.5
    stencil = _laplacian_stencil(image, free)
    rows, columns = np.nonzero(free)
    number = np.full((height, width), -1)
    number[free] = np.arange(rows.size)
    right = np.zeros(rows.size)
    entries = []
    for (down, across), weights in stencil.items():
        inside = (rows + down >= 0) & (rows + down < height) & (columns + across >= 0) & (columns + across < width)
        at = np.flatnonzero(inside)
        neighbour = (rows[at] + down, columns[at] + across)
        weight = weights[rows[at], columns[at]]
        fixed = number[neighbour] < 0
        right[at[fixed]] -= weight[fixed] * known[neighbour][fixed]
        entries.append((weight[~fixed], at[~fixed], number[neighbour][~fixed]))
    weight, at, other = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    weight[at == other] += TIE  # keeps a free patch that no window ties down solvable
    matrix = csc_array((weight, (at, other)), shape=(rows.size, rows.size))
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    alpha = known.copy()
    alpha[free] = factor.solve(right).clip(0, 1)
    return alpha


def _laplacian_stencil(image: NDArray[np.float64], free: NDArray[np.bool_]) -> Stencil:
    """Matting Laplacian (equation 12 of the paper, 3x3 windows) as weights [H,W] towards each neighbour offset.

    Only windows with a free pixel are summed.
    """
    height, width = free.shape
    touched = np.zeros_like(free)
    for row, column in OFFSETS:
        touched[1:-1, 1:-1] |= free[1 + row : height - 1 + row, 1 + column : width - 1 + column]
    centre = np.stack(np.nonzero(touched))
    middle = np.ravel_multi_index((centre[0], centre[1]), free.shape)
    pixels = [middle + row * width + column for row, column in OFFSETS]
    colours = image.reshape(-1, 3)[np.stack(pixels, axis=1)]  # [N,9,3]
    colours -= colours.mean(axis=1, keepdims=True)
    across = colours.swapaxes(1, 2)
    covariance = across @ colours / 9 + EPSILON / 9 * np.eye(3)
    affinity = np.ascontiguousarray(((1 + colours @ np.linalg.solve(covariance, across)) / 9).transpose(1, 2, 0))
    stencil: Stencil = {}
    for a, (row_a, column_a) in enumerate(OFFSETS):
        for b, (row_b, column_b) in enumerate(OFFSETS[a:], start=a):
            weights = stencil.setdefault((row_b - row_a, column_b - column_a), np.zeros((height, width)))
            weights.reshape(-1)[pixels[a]] += float(a == b) - affinity[a, b]
    # The Laplacian is symmetric: a pixel's weight towards a neighbour is the neighbour's towards the pixel.
    for (row, column), weights in list(stencil.items()):
        stencil[-row, -column] = np.roll(weights, (row, column), (0, 1))
    return stencil
