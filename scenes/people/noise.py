"""Smooth random functions of space, so that patterns run across the seams of the atlas."""

from __future__ import annotations

import torch
from torch import Tensor

_GRID = 24  # cells after which the noise repeats
_CHUNK = 131072  # points at a time, so that what lies between two steps stays in the cache


def value_noise(points: Tensor, frequency: float | tuple[float, float, float], generator: torch.Generator) -> Tensor:
    """Random values [N] in about [-1,1] at points [N,3], smooth over `1 / frequency` units of the points."""
    grid = 2 * torch.rand(_GRID, _GRID, _GRID, generator=generator) - 1
    # All eight corners of a cell side by side, so that each point reads memory once.
    corners = [grid.roll((-x, -y, -z), (0, 1, 2)) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    table = torch.stack(corners, -1).view(-1, 8)
    turns = torch.as_tensor(frequency, dtype=points.dtype).expand(3) / _GRID
    return torch.cat([_lookup(table, part * turns) for part in points.split(_CHUNK)])


def _lookup(table: Tensor, place: Tensor) -> Tensor:
    """Interpolate cells [24^3,8] at places [N,3] in units of the whole grid."""
    place = (place - place.floor()) * _GRID
    cell = place.floor().clamp_max(_GRID - 1)
    part = place - cell
    eased = part * part * (3 - 2 * part)
    x, y, z = cell.unbind(-1)
    values = table.index_select(0, ((x * _GRID + y) * _GRID + z).int())
    for axis, half in enumerate((4, 2, 1)):
        values = torch.lerp(values[:, :half], values[:, half:], eased[:, axis : axis + 1])
    return 1.6 * values[:, 0]


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
