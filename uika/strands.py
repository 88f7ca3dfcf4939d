"""Texture for hair that no photo shows: the strands that were seen, reflected to the far side of the head."""

from __future__ import annotations

import torch
from torch import Tensor

_SEEN = 0.8  # share of the observation from which a texel lends its strands
_MIN_TEXELS = 500  # fewer say nothing about hair
_EDGE = 0.08  # share of the seen hair that lies beyond the plane of reflection
_RISE = 0.55  # heights below the crown shrink by this much, so that the nape finds hair rather than a face


def strands(points: Tensor, color: Tensor, smooth: Tensor, seen: Tensor, hair: Tensor) -> Tensor:
    """What to add to smooth hair colours so that they look like the hair that was seen.

    Args:
        points: [M,3] texels on the head, metres, Y up.
        color: [M,3] observed colours.
        smooth: [M,3] the smooth continuation of those colours.
        seen: [M] share of each texel that was observed, in [0,1].
        hair: [M] how far each texel belongs to hair, in [0,1].

    Returns:
        Detail [M,3], 0 on skin and where too little hair was seen.
    """
    from scipy.spatial import cKDTree

    source = (seen > _SEEN) & (hair > 0.5)
    detail = torch.zeros_like(smooth)
    if int(source.sum()) < _MIN_TEXELS:
        return detail
    target = ~source & (hair > 0)
    level = torch.tensor([1.0, 0.0, 1.0])
    towards = torch.nn.functional.normalize((points[source].mean(0) - points[hair > 0.5].mean(0)) * level, dim=0)
    plane = torch.quantile(points[source] @ towards, _EDGE)
    wanted = points[target]
    along = wanted @ towards
    wanted = wanted + ((plane + (plane - along).abs()) - along)[:, None] * towards
    crown = points[source, 1].max()
    wanted[:, 1] = crown - _RISE * (crown - wanted[:, 1]).clamp_min(0)
    place = torch.nonzero(source).flatten()
    nearest = place[torch.from_numpy(cKDTree(points[source].numpy()).query(wanted.numpy(), workers=-1)[1])]
    detail[target] = hair[target, None] * (color[nearest] - smooth[nearest])
    return detail
