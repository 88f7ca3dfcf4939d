"""Pooling of all views into one UV observation with a confidence map (paper section 3.1)."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from uika.uv.holes import close_holes
from uika.uv.reprojection import Grid, Sums, accumulate, mean_color

Normalization = Literal["minmax", "max"]


class Aggregate(NamedTuple):
    """The pooled UV observation, float32."""

    rgb: Tensor  # [B,3,S,S] weighted mean of all pixels of all views, 0 where unseen
    confidence: Tensor  # [B,1,S,S] normalised log(1 + hits) in [0,1]
    hits: Tensor  # [B,1,S,S] n_hit: weight that fell on the texel, in pixels
    trust: Tensor  # [B,1,S,S] mean weight of the samples on the texel (1 where all weights are 1), 0 where unseen


@torch.no_grad()
def aggregate(
    images: Tensor,
    uv: Tensor,
    masks: Tensor,
    size: int,
    grid: Grid = "centers",
    weights: Tensor | None = None,
    *,
    normalization: Normalization = "minmax",
    oversample: int = 1,
    close_radius: int = 0,
    valid: Tensor | None = None,
) -> Aggregate:
    """Pool the pixels of all views (paper eq. 3); the order of the views does not matter.

    Arguments as in `uika.uv.accumulate`; `close_radius` > 0 closes pinholes inside `valid` [S,S] (see `close_holes`).
    `normalization`: "minmax" as in the paper, over the whole map of each item; "max" (minimum not subtracted) as in
    the released model. With "minmax", equal counts everywhere give 1 if they are positive and 0 if nothing was seen.
    """
    sums = accumulate(images, uv, masks, size, grid, weights, oversample=oversample)
    return pool(sums, normalization=normalization, close_radius=close_radius, valid=valid)


@torch.no_grad()
def pool(
    sums: Sums, *, normalization: Normalization = "minmax", close_radius: int = 0, valid: Tensor | None = None
) -> Aggregate:
    """The result of `aggregate` from the sums of `accumulate`, whose views may come from different calls."""
    weight, samples = sums.weight.sum(dim=1), sums.samples.sum(dim=1)
    rgb = mean_color(sums.color.sum(dim=1), weight).float()
    trust = mean_color(weight, samples).float()
    count = weight.float()
    if close_radius > 0:
        closed, count = close_holes(torch.cat([rgb, trust], dim=1), count, valid, close_radius)
        rgb, trust = closed[:, :3], closed[:, 3:]
    return Aggregate(rgb, _confidence(count, normalization), count, trust)


def _confidence(count: Tensor, normalization: Normalization) -> Tensor:
    logs = torch.log1p(count)
    high = logs.amax(dim=(1, 2, 3), keepdim=True)
    if normalization == "max":
        return logs / high.clamp_min(1e-6)
    if normalization != "minmax":
        raise ValueError(f'normalization must be "minmax" or "max", got {normalization!r}')
    low = logs.amin(dim=(1, 2, 3), keepdim=True)
    span = high - low
    uniform = (count > 0).to(logs.dtype)
    return torch.where(span > 0, (logs - low) / torch.where(span > 0, span, torch.ones_like(span)), uniform)
