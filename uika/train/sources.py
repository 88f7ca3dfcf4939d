"""The photos of an item, the head in them, and what their pixels show of it: exactly known or as in use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from uika.data.views import View
from uika.fitting import Fit, pixel_uv
from uika.head import HeadModel
from uika.train.augment import degrade, draw_grade
from uika.train.landmark_fit import fit_landmarks_with_errors
from uika.train.truth import exact_fit

GRADE_BETWEEN = 0.15  # strength of the grades in which photos of one head differ


@dataclass(frozen=True, eq=False)
class Sources:
    """N photos of S x S pixels of one head."""

    views: list[View]  # clean, in the photos' crops
    fit: Fit
    images: Tensor  # [N,3,S,S] on one colour
    masks: Tensor  # [N,S,S]
    uv: Tensor  # [N,2,S,S], NaN where no part of the head is shown
    weight: Tensor  # [N,S,S] trust in them
    exact: bool  # whether `fit` is the truth


def drawn_sources(
    views: Sequence[View], head: HeadModel, random: np.random.Generator, level: float, *, augment: bool, exact: bool
) -> Sources:
    """Photos with the true masks, and the true head or one that is fitted to landmarks with errors.

    Args:
        views: N of one head; they are cropped if `augment`.
        head: the head model.
        random: of crops, degradation and landmarks.
        level: grey behind the photos.
        augment: whether they suffer what cameras and files do.
        exact: whether the true head is known.
    """
    shown = [view.image for view in views]
    if augment:
        for view in views:
            view.jitter(random)
        shown = [degrade(draw_grade(random, GRADE_BETWEEN)(view.image), random) for view in views]
    background = torch.full((3,), level)
    images = torch.stack([view.over(background, image) for view, image in zip(views, shown, strict=True)])
    masks = torch.stack([view.mask for view in views])
    fit = exact_fit(views, head) if exact else fit_landmarks_with_errors(list(views), masks, head, random)
    uv, weight = located(fit, head, masks)
    labels = [view.uv for view in views if view.uv is not None]
    if exact and len(labels) == len(views) and any(bool(torch.isfinite(each).any()) for each in labels):
        # Glasses hide what the surface alone would show; a fit does not know that.
        weight = weight * torch.isfinite(torch.stack(labels)[:, 0])
    return Sources(list(views), fit, images, masks, uv, weight, exact)


def located(fit: Fit, head: HeadModel, masks: Tensor) -> tuple[Tensor, Tensor]:
    """UV maps [N,2,S,S] of the pixels that show a fitted head, NaN elsewhere, and the trust [N,S,S] in them."""
    uv, valid, weight = pixel_uv(fit, head, masks)
    return torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2), weight
