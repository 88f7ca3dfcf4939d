"""Losses and figures of the small correspondence estimator."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn import functional

from uika.model.surface_codes import UNIT, UvLookup
from uika.model.surface_estimator import NEAR, SurfaceMaps, chance_within
from uika.train.surface_augment import SurfaceBatch

TEXELS = 384  # of the atlas in which errors are counted
_PLACE, _SLOPE, _SPREAD, _HEAD, _HAIR = 10.0, 5.0, 0.05, 0.2, 0.1
_FAR = 0.3  # code units: neighbours farther apart lie on different surfaces
_SEEN = 0.3  # matte from which a pixel is asked for its place
_EASY = 0.1  # weight of the empty background in the question what is head


def surface_losses(maps: SurfaceMaps, batch: SurfaceBatch) -> dict[str, Tensor]:
    """Weighted losses; their sum is minimised."""
    known = (batch.shown > 0) & (batch.person > _SEEN)
    away = _distance(maps.code, batch.code)
    count = known.sum().clamp_min(1)
    place = (away * known).sum() / count
    spread = ((away.detach() * (-maps.spread).exp() + 2 * maps.spread) * known).sum() / count
    slope = torch.stack([_slope_loss(maps.code, batch.code, known, axis) for axis in (2, 3)]).sum()
    weight = torch.where(known | (batch.person > _SEEN), 1.0, _EASY)
    head = functional.binary_cross_entropy_with_logits(maps.head, known.float(), weight)
    hair = functional.binary_cross_entropy_with_logits(maps.hair, (batch.shown == 2).float(), known.float())
    return {
        "place": _PLACE * place,
        "slope": _SLOPE * slope,
        "spread": _SPREAD * spread,
        "head": _HEAD * head,
        "hair": _HAIR * hair,
    }


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return ((a - b).square().sum(1) + 1e-8).sqrt()


def _slope_loss(found: Tensor, truth: Tensor, known: Tensor, axis: int) -> Tensor:
    """Mean error [] of the steps from pixel to pixel along an axis, inside surfaces."""
    step = truth.diff(dim=axis)
    both = known.narrow(axis - 1, 1, known.shape[axis - 1] - 1) & known.narrow(axis - 1, 0, known.shape[axis - 1] - 1)
    inside = both & (step.square().sum(1) < _FAR**2)
    error = _distance(found.diff(dim=axis), step)
    return (error * inside).sum() / inside.sum().clamp_min(1)


@torch.no_grad()
def surface_figures(pairs: Iterable[tuple[SurfaceMaps, SurfaceBatch]], lookup: UvLookup) -> dict[str, float]:
    """What the estimator gets wrong.

    `skin` and `hair`: median error in texels of an atlas of 384, `skin_90` and `hair_90` the 90th percentile;
    `sure`: share of the head's pixels with a confidence over one half, `sure_error` their median error, `kept`: how
    many of these lie within 6.5 mm, `promised`: how many the confidence says; `missed`: the head's pixels not taken
    for the head, `false`: other pixels of the person that are.
    """
    errors, hair, chances, near = [], [], [], []
    missed = false = heads = others = 0
    for maps, batch in pairs:
        known = (batch.shown > 0) & (batch.person > 0.5)
        found, truth = maps.code.permute(0, 2, 3, 1)[known], batch.code.permute(0, 2, 3, 1)[known]
        errors.append((lookup(found)[0] - lookup(truth)[0]).norm(dim=-1) * TEXELS)
        hair.append(batch.shown[known] == 2)
        chances.append(chance_within(NEAR / UNIT, maps.spread)[known] * maps.head.sigmoid()[known])
        near.append((found - truth).norm(dim=-1) < NEAR / UNIT)
        other = (batch.shown == 0) & (batch.person > 0.9)
        missed += int((maps.head[known] < 0).sum())
        false += int((maps.head[other] > 0).sum())
        heads, others = heads + int(known.sum()), others + int(other.sum())
    error, is_hair, chance, close = (torch.cat(parts) for parts in (errors, hair, chances, near))
    sure = chance > 0.5
    result = {"sure": float(sure.float().mean()), "missed": missed / max(heads, 1), "false": false / max(others, 1)}
    for name, at in (("skin", ~is_hair), ("hair", is_hair)):
        if bool(at.any()):
            result |= {name: float(error[at].median()), f"{name}_90": float(_high(error[at]))}
    if bool(sure.any()):
        result |= {
            "sure_error": float(error[sure].median()),
            "kept": float(close[sure].float().mean()),
            "promised": float(chance[sure].mean()),
        }
    return result


def _high(values: Tensor) -> Tensor:
    return values.kthvalue(max(1, round(0.9 * len(values)))).values
