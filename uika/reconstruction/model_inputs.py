"""What the model is fed: the same in training as in use."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from uika.canonical.prior import prior_colors
from uika.canonical.regions import MOUTH, regions
from uika.canonical.surface import surface_texels, template_texels
from uika.head import Binding, HeadModel
from uika.model import ModelConfig, SurfaceTexels
from uika.uv import Aggregate, aggregate

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
    head = head.without_bust
    views, masks, uvs, weights = images[None], mattes[None, :, None], uv[None], weight[None, :, None]
    if config.canonical == "template":
        # Every pixel counts, nothing is supposed: what no photo shows is the network's to say.
        surface, binding = template_texels(head, config.map_size)
        return ModelInputs(views, masks, uvs, weights, binding.texel, surface), binding
    surface, binding = surface_texels(head, identity, static_offset, config.map_size)
    weights = weights * plausible(head, binding, uvs)
    oversample = config.uv.oversample
    pooled = aggregate(views, uvs, masks, binding.size, weights=weights, oversample=oversample)
    prior = surface_prior(config, head, binding, static_offset, pooled, levels(images, weight))
    return ModelInputs(views, masks, uvs, weights, binding.texel, replace(surface, prior=prior)), binding


def surface_prior(
    config: ModelConfig, head: HeadModel, binding: Binding, static_offset: Tensor, pooled: Aggregate, levels: Tensor
) -> Tensor:
    """Colours [3,S,S] for what no photo shows, from all photos pooled and the `levels` of their pixels."""
    known = (pooled.trust[0, 0] / config.uv.full_trust).clamp(0, 1)
    return prior_colors(head, binding, static_offset, pooled.rgb[0], known, _brightness(levels))


def plausible(head: HeadModel, binding: Binding, uv: Tensor) -> Tensor:
    """0 for pixels [1,V,1,H,W] that seem to show the inside of the mouth, else 1.

    A fit that is a millimetre off puts teeth on the tongue, where they stay when the mouth opens.
    """
    labels = regions(head, binding)
    size = len(labels)
    column, row = (torch.nan_to_num(uv) * size).long().clamp(0, size - 1).unbind(2)
    return (labels[row, column] != MOUTH).to(uv.dtype)[:, :, None]


def levels(images: Tensor, weight: Tensor) -> Tensor:
    """Grey levels [P] of the pixels of photos [N,3,H,W] that show the head well, by their trust [N,H,W]."""
    return images.mean(1)[weight > 0.5]


def _brightness(levels: Tensor) -> float:
    """How bright the photos show the head: the median level over that of skin in even light."""
    return 1.0 if len(levels) == 0 else float((levels.median() / _MID_FACE).clamp(0.3, 1.15))
