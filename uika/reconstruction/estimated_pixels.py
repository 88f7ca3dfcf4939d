"""What the pixels of photos show according to a correspondence estimator, and how far that is to be trusted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from uika.fitting.pixel_correspondence import matte_trust

if TYPE_CHECKING:
    from uika.model.estimator_file import AnyEstimator
    from uika.model.surface_estimator import SurfaceEstimator

_AGREED, _DENIED = 0.03, 0.06  # of the atlas: distances between which a fit's place loses an estimator's consent


@torch.no_grad()
def estimated_pixels(estimator: AnyEstimator, images: Tensor, mattes: Tensor) -> tuple[Tensor, Tensor]:
    """UV maps [1,N,2,S,S], NaN where a pixel shows no part of the head, and the trust [N,S,S] in them.

    Args:
        estimator: one that says how sure it is, or one of the paper's kind, which believes every pixel.
        images: [N,3,S,S] in [0,1] on one plain colour.
        mattes: [N,S,S] in [0,1].
    """
    from uika.model.surface_estimator import SurfaceEstimator

    if not isinstance(estimator, SurfaceEstimator):
        uv = estimator(images[None]).float()
        return torch.where(mattes[None, :, None] > 0, uv, torch.nan), mattes
    seen = estimator.observe(images[None])
    weight = seen.confidence[0] * torch.stack([matte_trust(matte) for matte in mattes])
    return torch.where(weight[None, :, None] > 0, seen.uv, torch.nan), weight


@torch.no_grad()
def consent(estimator: SurfaceEstimator, images: Tensor, uv: Tensor) -> Tensor:
    """How far [N,S,S] in [0,1] the estimator leaves a fit's correspondence alone.

    It takes trust from pixels that it surely sees elsewhere on the head: hair before the face, a hand, an ear that the
    fit has in another place.

    Args:
        estimator: the estimator.
        images: [N,3,S,S] in [0,1] on one plain colour.
        uv: [N,2,S,S] of the fit, NaN where it has none.
    """
    seen = estimator.observe(images[None])
    away = (seen.uv[0] - uv).norm(dim=1).nan_to_num()
    return 1 - seen.confidence[0] * ((away - _AGREED) / (_DENIED - _AGREED)).clamp(0, 1)
