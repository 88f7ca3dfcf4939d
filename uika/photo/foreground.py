"""Foreground colours of a matted image, coarse to fine (Germer, Uelwer, Conrad and Harmeling 2020)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SMOOTHNESS, EDGE_WEIGHT = 1e-5, 1.0  # weight of a neighbour: the first plus the second times the matte's step
SMALL_LEVEL = 32  # pixels: levels up to this size spread colours far and cost little
MANY_SWEEPS, FEW_SWEEPS = 20, 4


def estimate_foreground(image: NDArray[np.float32], alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """Foreground [S,S,3] such that alpha F + (1 - alpha) B reproduces image [S,S,3], with F and B smooth.

    Each level solves every pixel's 2x2 system for F and B with its neighbours held, sweep by sweep.
    """
    size = image.shape[0]
    both = np.broadcast_to(image.mean(axis=(0, 1)), (1, 1, 2, 3)).astype(np.float32)
    levels = max(1, int(np.ceil(np.log2(size))))
    for level in range(levels + 1):
        side = max(1, round(size ** (level / levels)))
        at = ((np.arange(side) + 0.5) * size / side).astype(int)
        from_coarser = (np.arange(side) * both.shape[0]) // side
        both = both[from_coarser[:, None], from_coarser]
        both = _sweeps(image[at[:, None], at], alpha[at[:, None], at], both, side)
    return both[..., 0, :]


def _sweeps(
    image: NDArray[np.float32], alpha: NDArray[np.float32], both: NDArray[np.float32], side: int
) -> NDArray[np.float32]:
    """Jacobi sweeps over F and B, `both` [S,S,2,3]."""
    weights = [SMOOTHNESS + EDGE_WEIGHT * np.abs(alpha - near) for near in _neighbours(alpha)]
    total = sum(weights[1:], weights[0])
    back = 1 - alpha
    determinant = total * (alpha**2 + back**2 + total)
    share = np.stack([alpha, back], axis=-1)[..., None]
    for _ in range(MANY_SWEEPS if side <= SMALL_LEVEL else FEW_SWEEPS):
        right = share * image[:, :, None]
        for weight, near in zip(weights, _neighbours(both), strict=True):
            right = right + weight[..., None, None] * near
        front = (back**2 + total)[..., None] * right[:, :, 0] - (alpha * back)[..., None] * right[:, :, 1]
        behind = (alpha**2 + total)[..., None] * right[:, :, 1] - (alpha * back)[..., None] * right[:, :, 0]
        both = (np.stack([front, behind], axis=2) / determinant[..., None, None]).clip(0, 1)
    return both


def _neighbours(values: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """The four neighbours of every pixel of values [S,S,...]; at the border the pixel itself."""
    padded = np.pad(values, [(1, 1), (1, 1)] + [(0, 0)] * (values.ndim - 2), mode="edge")
    return [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]
