"""Closing of pinholes between reprojected texels by normalised convolution."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional


@torch.no_grad()
def close_holes(values: Tensor, weight: Tensor, valid: Tensor | None = None, radius: int = 2) -> tuple[Tensor, Tensor]:
    """Give texels at most `radius` texels (per axis) from a seen one the weighted average of their neighbours.

    values [B,C,S,S], weight [B,1,S,S] (0 = unseen), valid [S,S] bool or None (texels that may be filled).
    Returns (values, weight); seen texels are returned unchanged, a closed texel's weight is the mean weight of the
    seen texels around it. Raises ValueError for a radius below 1.
    """
    if radius < 1:
        raise ValueError(f"radius must be at least 1 texel, got {radius}")
    channels = values.shape[1]
    seen = weight > 0
    sums = _blur(torch.cat([values * weight, weight, seen.to(values.dtype)], dim=1), radius)
    total, neighbours = sums[:, channels : channels + 1], sums[:, channels + 1 :]
    hole = ~seen & (neighbours > 0)
    if valid is not None:
        hole &= valid
    tiny = torch.finfo(values.dtype).tiny
    closed = sums[:, :channels] / total.clamp_min(tiny)
    mean_weight = total / neighbours.clamp_min(tiny)
    return torch.where(hole, closed, values), torch.where(hole, mean_weight, weight)


@torch.no_grad()
def close_gaps(values: Tensor, weight: Tensor, valid: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """`close_holes` for gaps alone: what lies beyond the border of all that was seen stays unseen.

    Arguments and results as those of `close_holes`; a gap is what a morphological closing by `radius` fills.
    """
    seen = (weight > 0).to(values.dtype)
    reach = 2 * radius + 1
    grown = functional.max_pool2d(seen, reach, 1, radius)
    inside = -functional.max_pool2d(-grown, reach, 1, radius) > 0
    closed, share = close_holes(values, weight, valid, radius)
    return torch.where(inside, closed, values), torch.where(inside, share, weight)


def _blur(maps: Tensor, radius: int) -> Tensor:
    """Separable Gaussian of sigma radius/2 cut at `radius`, zeros outside the map."""
    weights = [math.exp(-2 * (offset / radius) ** 2) for offset in range(-radius, radius + 1)]
    total = sum(weights)
    # A few shifted sums are many times faster than a convolution of single channels.
    for axis, padding in ((-2, (0, 0, radius, radius)), (-1, (radius, radius))):
        size = maps.shape[axis]
        padded = functional.pad(maps, padding)
        maps = padded.narrow(axis, 0, size) * (weights[0] / total)
        for shift, weight in enumerate(weights[1:], start=1):
            maps.add_(padded.narrow(axis, shift, size), alpha=weight / total)
    return maps
