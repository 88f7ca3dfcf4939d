"""From tokens and the observation to the attributes of every Gaussian (paper section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.canonical.surface import SurfaceTexels
from uika.model.attribute_heads import AttributeHeads, Attributes, Palette, TexelMlp
from uika.model.config import ModelConfig
from uika.model.dpt import UvDpt, resize

_LIFT_UNIT, _SHAPE_UNIT = 10.0, 30.0  # channel values of a metre of hair, of a metre off the mean head
_COARSE = 52  # what is wider than this part of the atlas is no fine relief
_SEEN = 0.1  # share of the observation from which a texel counts as seen
_PREDICTED = (
    0.5  # share of predictions in unseen colours: their mean with the completed observation errs less than either
)
_TEXELS = 8192  # at once: few enough to stay in the processor's cache, changes no value


class GaussianDecoder(nn.Module):
    """Tokens and aggregate -> Gaussian attributes at the valid texels (paper eq. 8)."""

    def __init__(self, config: ModelConfig) -> None:
        """Sizes from `config`."""
        super().__init__()
        self.map_size = config.map_size
        self.aggregation, self.surface = config.aggregation, config.surface
        self.detail = config.detail if config.aggregation else 0.0
        self.scope, self.init_opacity = config.scope, config.gaussians.init_opacity
        self.dpt_decoder = UvDpt(config)
        self.mlp_net = TexelMlp(config.dpt_features, config.mlp_width)
        self.gs_net = AttributeHeads(config)
        if self.gs_net.palette:
            self.palette = Palette(config.dpt_features, config.palette)

    def forward(
        self, tokens: list[Tensor], observed: Tensor, texel: Tensor, surface: SurfaceTexels, known: Tensor
    ) -> Attributes:
        """Tokens of four depths, observed [B,4,S,S], texel [M], known [B,1,S,S] as in `Observation`."""
        maps = [observed] if self.aggregation else []
        if self.surface and surface.lift is not None and surface.shape is not None:
            stand = torch.cat((_LIFT_UNIT * surface.lift, _SHAPE_UNIT * surface.shape))
            maps.append(stand.to(observed.dtype).expand(len(observed), -1, -1, -1))
        seen_maps = torch.cat(maps, dim=1) if maps else observed
        coarse = self.dpt_decoder(tokens, seen_maps).contiguous(memory_format=torch.channels_last)
        features = resize(coarse, (self.map_size, self.map_size))
        features, seen = _gather(features, texel), _gather(observed, texel)
        # Attributes are read to a fraction of a millimetre, finer than bfloat16 tells numbers apart.
        with torch.autocast(features.device.type, enabled=False):
            parts = []
            palette = self.palette(features.to(seen.dtype), seen) if self.gs_net.palette else None
            for first in range(0, max(len(texel), 1), _TEXELS):
                rows = slice(first, first + _TEXELS)
                inner = self.mlp_net(features[:, rows].to(seen.dtype))
                parts.append(self.gs_net(inner, seen[:, rows], surface.rows(first, first + _TEXELS), palette))
        result = Attributes(*(torch.cat(values, dim=1) for values in zip(*parts, strict=True)))
        if self.detail:
            relief = _gather(_fine(observed[:, :3], texel), texel)
            colors = result.colors + self.detail * result.fusion_weight[..., None] * relief
            result = result._replace(colors=colors.clamp(0, 1))
        if self.scope == "all":
            return result
        assert surface.face is not None
        share = _gather(surface.face[None], texel)
        if self.scope == "unseen_colors":
            unseen = (1 - _gather(known, texel).to(seen.dtype) / _SEEN).clamp_min(0)
            share = _PREDICTED * (1 - share) * unseen
            if surface.regions is not None:  # eyes and mouths are not completed from what is around them
                share = share * (surface.regions.flatten()[texel] == 0)[None, :, None]
        return self._colors_alone(result, seen[..., :3], share, surface)

    def _colors_alone(self, result: Attributes, seen: Tensor, share: Tensor, surface: SurfaceTexels) -> Attributes:
        """The surface in the colours of the observation [B,M,3], with a share [B or 1,M,1] of predicted ones."""
        return Attributes(
            offsets=torch.zeros_like(result.offsets),
            quats=surface.quats.expand_as(result.quats),
            scales=surface.scales.expand_as(result.scales),
            opacities=torch.full_like(result.opacities, self.init_opacity),
            colors=torch.lerp(seen, result.colors, share),
            fusion_weight=result.fusion_weight * share[..., 0],
        )


def _fine(color: Tensor, texel: Tensor) -> Tensor:
    """What [B,3,S,S] sets colours apart from the mean around them, of valid texels alone."""
    size = color.shape[-1]
    reach = size // _COARSE
    valid = color.new_zeros(size * size)
    valid[texel] = 1
    valid = valid.view(1, 1, size, size)

    around = torch.cat((color * valid, valid.expand(len(color), -1, -1, -1)), dim=1)
    for _ in range(2):
        around = _box_sums(_box_sums(around, reach, -1), reach, -2) / (2 * reach + 1) ** 2
    return color - around[:, :3] / around[:, 3:].clamp_min(1e-6)


def _box_sums(maps: Tensor, reach: int, axis: int) -> Tensor:
    """Sums along an axis of all that is at most `reach` away: differences of one running sum."""
    running = functional.pad(maps, (0, 0) * (-1 - axis) + (reach + 1, reach)).cumsum(axis)
    size = maps.shape[axis]
    return running.narrow(axis, 2 * reach + 1, size) - running.narrow(axis, 0, size)


def _gather(maps: Tensor, texel: Tensor) -> Tensor:
    """[B,C,S,S] at row-major texels [M] -> [B,M,C]."""
    # Whole rows of channels are picked, which lie together in maps that are channels last.
    return maps.permute(0, 2, 3, 1).flatten(1, 2).index_select(1, texel)
