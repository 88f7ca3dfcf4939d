"""Colours for texels no photo shows: the mirrored side of the face first, smooth diffusion for the rest."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

# Lighting differs between the two halves of a face; it is compared over blocks of this many texels, and never
# trusted beyond this much, so that a few bad pixels at a silhouette cannot tint a whole cheek.
_BLOCK = 8
_MAX_RELIGHT = 0.2


@torch.no_grad()
def fill(
    rgb: Tensor,
    confidence: Tensor,
    valid: Tensor,
    mirror: Tensor | None = None,
    default: tuple[float, float, float] = (0.5, 0.5, 0.5),
    *,
    regions: Tensor | None = None,
    prior: Tensor | None = None,
) -> Tensor:
    """Complete a UV observation.

    rgb         [B,3,S,S] observed colours
    confidence  [B,1,S,S] share of the observation in the result, clamped to [0,1]: 1 keeps rgb, 0 means unseen,
                values between blend softly into the completed colour
    valid       [S,S] bool texels that belong to the head; no other texel is ever a source
    mirror      [S,S] int64 row-major index of the texel on the other half of the face, -1 where there is none
    default     colour where nothing at all was seen
    regions     [S,S] int64 labels; diffusion does not cross from one label to another (skin, eyeballs, teeth)
    prior       [3,S,S] colours to use instead of diffusion (teeth behind closed lips), NaN where there is none

    A texel takes its own colour, then (as far as that is missing) the mirrored one, corrected by the smooth lighting
    difference between both halves, then the prior, then the diffusion of what is known. Returns [B,3,S,S]; texels
    outside `valid` carry diffused colour so that resizing the map does not darken the borders of charts.
    Raises ValueError for arguments that do not fit.
    """
    _check(rgb, confidence, valid, mirror, regions, prior)
    known = torch.nan_to_num(confidence).clamp(0, 1) * valid
    color = torch.where(known > 0, rgb, torch.zeros_like(rgb))
    base = torch.tensor(default, dtype=rgb.dtype, device=rgb.device)[None, :, None, None].expand_as(rgb)
    if mirror is not None:
        color, known = _add_mirrored(color, known, valid, mirror)
    completion = diffuse(color, known, base) if regions is None else _by_region(color, known, base, valid, regions)
    if prior is not None:
        completion = torch.where(torch.isfinite(prior), prior, completion)
    result = torch.where(known >= 1, color, known * color + (1 - known) * completion)
    if regions is None and prior is None:
        return result
    return diffuse(result, valid.to(rgb.dtype).expand_as(known), base)


def _by_region(color: Tensor, known: Tensor, base: Tensor, valid: Tensor, regions: Tensor) -> Tensor:
    """Diffusion inside each region, over the region's bounding box."""
    result = base.clone()
    for label in regions[valid].unique():
        inside = valid & (regions == label)
        rows, columns = inside.any(dim=1).nonzero()[:, 0], inside.any(dim=0).nonzero()[:, 0]
        box = (..., slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
        diffused = diffuse(color[box], (known * inside)[box], base[box])
        result[box] = torch.where(inside[box], diffused, result[box])
    return result


def diffuse(values: Tensor, weight: Tensor, default: Tensor) -> Tensor:
    """Pull-push interpolation of values [B,C,H,W] known with weight [B,1,H,W] in [0,1].

    Texels of weight 1 are returned as they are, others receive a smooth continuation; `default` [B,C,H,W] fills items
    without any known texel.
    """
    levels = [(values * weight, weight)]
    while max(levels[-1][0].shape[-2:]) > 1:
        colored, share = levels[-1]
        colored = functional.avg_pool2d(colored, 2, ceil_mode=True)
        share = functional.avg_pool2d(share, 2, ceil_mode=True)
        # A cell counts as known once a quarter of it is: coarser levels must not outvote near texels.
        gain = torch.where(share > 0, (4 * share).clamp_max(1) / share.clamp_min(1e-12), torch.zeros_like(share))
        levels.append((colored * gain, share * gain))
    colored, share = levels[-1]
    top = default.mean(dim=(-2, -1), keepdim=True)
    result = torch.where(share > 0, colored / share.clamp_min(1e-12), top)
    for colored, share in reversed(levels[:-1]):
        coarse = functional.interpolate(result, size=colored.shape[-2:], mode="bilinear", align_corners=False)
        result = colored + (1 - share) * coarse
    return torch.where(weight >= 1, values, result)


def _add_mirrored(color: Tensor, known: Tensor, valid: Tensor, mirror: Tensor) -> tuple[Tensor, Tensor]:
    """Put the mirrored, relit observation under the direct one."""
    source = mirror.clamp_min(0).flatten()
    usable = (mirror >= 0) & valid
    other = color.flatten(2)[:, :, source].reshape(color.shape)
    other_known = known.flatten(2)[:, :, source].reshape(known.shape) * usable
    both = known * other_known
    other = (other + _lighting_difference(color - other, both)).clamp(0, 1)
    share = (1 - known) * other_known
    total = known + share
    mixed = (known * color + share * other) / total.clamp_min(1e-12)
    return torch.where(known >= 1, color, mixed), total


def _lighting_difference(difference: Tensor, weight: Tensor) -> Tensor:
    """Smooth continuation of `difference` [B,3,S,S] from where `weight` [B,1,S,S] is positive; 0 if it is nowhere."""
    share = functional.avg_pool2d(weight, _BLOCK, ceil_mode=True)
    mean = functional.avg_pool2d(difference * weight, _BLOCK, ceil_mode=True) / share.clamp_min(1e-12)
    smooth = diffuse(mean.clamp(-_MAX_RELIGHT, _MAX_RELIGHT), (4 * share).clamp_max(1), torch.zeros_like(mean))
    return functional.interpolate(smooth, size=difference.shape[-2:], mode="bilinear", align_corners=False)


def _check(
    rgb: Tensor,
    confidence: Tensor,
    valid: Tensor,
    mirror: Tensor | None,
    regions: Tensor | None,
    prior: Tensor | None,
) -> None:
    if rgb.ndim != 4 or rgb.shape[1] != 3:
        raise ValueError(f"rgb must be [B,3,S,S], got {list(rgb.shape)}")
    height, width = rgb.shape[-2:]
    if list(confidence.shape) != [rgb.shape[0], 1, height, width]:
        raise ValueError(f"confidence must be {[rgb.shape[0], 1, height, width]}, got {list(confidence.shape)}")
    if list(valid.shape) != [height, width] or valid.dtype != torch.bool:
        raise ValueError(f"valid must be a bool map {[height, width]}, got {valid.dtype} {list(valid.shape)}")
    for name, labels in (("mirror", mirror), ("regions", regions)):
        if labels is not None and (list(labels.shape) != [height, width] or labels.dtype != torch.int64):
            raise ValueError(f"{name} must be an int64 map {[height, width]}, got {labels.dtype} {list(labels.shape)}")
    if mirror is not None and bool((mirror >= height * width).any()):
        raise ValueError(f"mirror holds texel indices beyond {height * width - 1}")
    if prior is not None and list(prior.shape) != [3, height, width]:
        raise ValueError(f"prior must be {[3, height, width]}, got {list(prior.shape)}")
