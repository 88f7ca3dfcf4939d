"""The oracle's blending where all pairs at once would not fit into memory: the same rules, a few splats at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from ._settings import Settings

SPLATS = 64  # that are blended together
PIXELS = 1 << 16  # that are looked at together


def blend_large(splats: dict[str, Tensor], pixels: Tensor, settings: Settings) -> tuple[Tensor, Tensor, Tensor]:
    """Sums [P, D], coverage [P] and margin [P] at pixel centres [P, 2], without gradients.

    `splats` are the arguments of `_blend` near to far, and instead of conics the `covariance` [V, 3] and its
    `determinant` [V]. A pixel that has stopped is left alone; its margin is that of what it saw until then.
    """
    given = dict(splats)
    xx, xy, yy = (given.pop("covariance") / given.pop("determinant")[:, None]).unbind(-1)
    conics = torch.stack([yy, -xy, xx], -1)
    parts = [_blend(**given, conics=conics, pixels=block, settings=settings) for block in pixels.split(PIXELS)]
    sums, left, margins = (torch.cat(found) for found in zip(*parts, strict=True))
    return sums, -torch.expm1(left), margins


def _blend(
    means2d: Tensor,  # [V, 2]
    conics: Tensor,  # [V, 3] xx, xy, yy of the inverse covariance
    opacities: Tensor,  # [V]
    span: Tensor,  # [V, 2, 2]
    features: Tensor,  # [V, D]
    pixels: Tensor,  # [P, 2]
    settings: Settings,
) -> tuple[Tensor, Tensor, Tensor]:
    alpha_min, alpha_max, t_min = settings.options.alpha_min, settings.alpha_max, settings.options.transmittance_min
    sums = pixels.new_zeros(len(pixels), features.shape[1])
    left = pixels.new_zeros(len(pixels))  # logarithm of the transmittance
    margin = torch.full_like(left, torch.inf)
    alive = torch.arange(len(pixels), device=pixels.device)
    for first in range(0, len(means2d), SPLATS):
        if not len(alive):
            break
        some = slice(first, first + SPLATS)
        place = pixels[alive]
        dx, dy = (place[None] - means2d[some, None]).unbind(-1)
        xx, xy, yy = conics[some, :, None].unbind(1)
        raw = opacities[some, None] * torch.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
        alpha = raw.clamp_max(alpha_max)
        allowed = ((place > span[some, None, :, 0]) & (place < span[some, None, :, 1])).all(-1)
        hit = (alpha >= alpha_min) & allowed
        after = (left[alive] + torch.cumsum(torch.log1p(-alpha * hit), 0)).exp()
        keep = hit & (after > t_min)
        alpha = alpha * keep
        if settings.closing:
            stops = hit & (after <= t_min)
            alpha = torch.where(stops & (torch.cumsum(stops, 0) == 1), torch.ones_like(alpha), alpha)
        kept = left[alive] + torch.cumsum(torch.log1p(-alpha), 0)
        before = torch.cat([left[alive][None], kept[:-1]]).exp()
        sums[alive] += (alpha * before).T @ features[some]
        near = torch.minimum((raw / alpha_min - 1).abs(), (raw / alpha_max - 1).abs())
        near = torch.minimum(near, torch.where(hit, (after / t_min - 1).abs(), torch.inf))
        margin[alive] = torch.minimum(margin[alive], torch.where(allowed, near, torch.inf).amin(0))
        left[alive] = kept[-1]
        alive = alive[after[-1] > t_min]
    return sums, left, margin
