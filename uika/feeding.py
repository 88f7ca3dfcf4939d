"""What the model is fed: the same in training as in use."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from uika.complete import MOUTH, regions, suppose
from uika.head import Binding, HeadModel
from uika.model import ModelConfig, SurfaceTexels
from uika.surface import surface_texels
from uika.uv import aggregate

_MID_FACE = 0.55  # sRGB level of skin in even light, for judging how bright the photos are


class ModelInputs(NamedTuple):
    """Arguments of `Reconstructor.forward` for one head, in its order; batch dimension 1."""

    images: Tensor  # [1,V,3,H,W]
    masks: Tensor  # [1,V,1,H,W]
    uv: Tensor  # [1,V,2,H,W]
    weights: Tensor  # [1,V,1,H,W]
    texel: Tensor  # [M]
    surface: SurfaceTexels


@torch.no_grad()
def model_inputs(
    config: ModelConfig,
    head: HeadModel,
    identity: Tensor,
    static_offset: Tensor,
    images: Tensor,
    mattes: Tensor,
    uv: Tensor,
    weight: Tensor,
) -> tuple[ModelInputs, Binding]:
    """Everything the model is told about one head, and the binding of its texels.

    Args:
        config: of the model.
        head: the head model.
        identity: [K] standard deviations.
        static_offset: [V,3] metres.
        images: [N,3,H,W] photos on one solid colour.
        mattes: [N,H,W] in [0,1].
        uv: [N,2,H,W] correspondences with v down, NaN where a pixel shows no part of the head.
        weight: [N,H,W] trust in them, in [0,1].
    """
    surface, binding = surface_texels(head, identity, static_offset, config.map_size)
    views, masks, uvs, weights = images[None], mattes[None, :, None], uv[None], weight[None, :, None]
    weights = weights * _plausible(regions(head, binding), uvs)
    oversample = config.uv.oversample
    pooled = aggregate(views, uvs, masks, binding.size, weights=weights, oversample=oversample)
    known = (pooled.trust[0, 0] / config.uv.full_trust).clamp(0, 1)
    prior = suppose(head, binding, static_offset, pooled.rgb[0], known, _brightness(images, weight))
    return ModelInputs(views, masks, uvs, weights, binding.texel, replace(surface, prior=prior)), binding


def _plausible(labels: Tensor, uv: Tensor) -> Tensor:
    """0 for pixels [1,V,1,H,W] that seem to show the inside of the mouth, else 1.

    A fit that is a millimetre off puts teeth on the tongue, where they stay when the mouth opens.
    """
    size = len(labels)
    column, row = (torch.nan_to_num(uv) * size).long().clamp(0, size - 1).unbind(2)
    return (labels[row, column] != MOUTH).to(uv.dtype)[:, :, None]


def _brightness(images: Tensor, weight: Tensor) -> float:
    """How bright the photos show the head: median level of its well-seen pixels over that of skin in even light."""
    levels = images.mean(1)[weight > 0.5]
    return 1.0 if len(levels) == 0 else float((levels.median() / _MID_FACE).clamp(0.3, 1.15))
