"""Smooth random functions of space, so that patterns run across the seams of the atlas."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

_GRID = 24  # cells after which the noise repeats


def value_noise(points: Tensor, frequency: float | tuple[float, float, float], generator: torch.Generator) -> Tensor:
    """Random values [N] in about [-1,1] at points [N,3], smooth over `1 / frequency` units of the points."""
    grid = 2 * torch.rand(_GRID, _GRID, _GRID, generator=generator) - 1
    # One more layer at the end repeats the first, so that interpolation wraps.
    for axis in range(3):
        grid = torch.cat((grid, grid.narrow(axis, 0, 1)), axis)
    place = (points * torch.as_tensor(frequency, dtype=points.dtype) + 1000.0) % _GRID
    whole = place.floor()
    part = place - whole
    eased = whole + part * part * (3 - 2 * part)
    coordinates = eased * (2 / _GRID) - 1
    sampled = grid_sample(grid[None, None], coordinates.view(1, -1, 1, 1, 3), align_corners=True)
    return 1.6 * sampled.view(-1)


def fractal_noise(
    points: Tensor, frequency: float | tuple[float, float, float], generator: torch.Generator, octaves: int = 4
) -> Tensor:
    """Sum [N] of `octaves` of `value_noise`, each twice as fine and 0.55 times as strong as the last."""
    total, scale = torch.zeros(len(points)), 1.0
    base = torch.as_tensor(frequency, dtype=points.dtype).expand(3)
    for octave in range(octaves):
        bands = tuple((base * 2**octave).tolist())
        total += scale * value_noise(points, bands, generator)
        scale *= 0.55
    return total


def smoothstep(low: float, high: float, values: Tensor) -> Tensor:
    """0 below `low`, 1 above `high`, smooth between; `low` may exceed `high` for a falling step."""
    share = ((values - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
