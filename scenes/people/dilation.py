"""Carrying the border values of an atlas' charts outwards, so that interpolation meets no background."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from uika.head import HeadModel, uv_texels

_REACH = 6  # texels beyond the edges of the charts


def dilate(values: Tensor, head: HeadModel, size: int) -> Tensor:
    """Fill the texels around the charts of an atlas map [C,S,S] with means of their neighbours, ring after ring."""
    flat = values.reshape(len(values), -1).clone()
    for texel, neighbour, weight in _rings(head, size):
        flat[:, texel] = (flat[:, neighbour] * weight).sum(-1)
    return flat.view_as(values)


@lru_cache(maxsize=2)
def _rings(head: HeadModel, size: int) -> tuple[tuple[Tensor, Tensor, Tensor], ...]:
    """For each ring its texels [N], their neighbours [N,9] and the neighbours' weights [N,9]."""
    step = torch.tensor([-1, 0, 1])
    covered = uv_texels(head, size).valid.clone()
    rings = []
    for _ in range(_REACH):
        near = max_pool2d(covered[None].float(), 3, 1, 1)[0] > 0
        row, column = (near & ~covered).nonzero().unbind(-1)
        y = (row[:, None, None] + step[:, None]).expand(-1, 3, 3).reshape(-1, 9)
        x = (column[:, None, None] + step).expand(-1, 3, 3).reshape(-1, 9)
        inside = (y >= 0) & (y < size) & (x >= 0) & (x < size)
        neighbour = y.clamp(0, size - 1) * size + x.clamp(0, size - 1)
        weight = (covered.flatten()[neighbour] & inside).float()
        rings.append((row * size + column, neighbour, weight / weight.sum(-1, keepdim=True)))
        covered = covered | near
    return tuple(rings)
