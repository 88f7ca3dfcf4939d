"""Per-texel MLP and one linear layer per Gaussian attribute (paper section 3.3 and table S1)."""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.canonical.surface import SurfaceTexels
from uika.head.rotations import multiply_quaternions
from uika.model.config import ModelConfig

# Keeps exp and its gradient finite whatever the network says; far above any scale that survives the clip.
_MAX_LOG_SCALE = 15.0
_COLOR_GAIN = 4.0  # sigmoid(4 * (c - 1/2)) is close to c
_OWN = 3.0  # first logit of a texel's own colour among those of the palette
_LEAST_SEEN = 1e-4  # confidence that keeps a palette of nothing finite


class Attributes(NamedTuple):
    """Gaussian attributes at M texels; shapes as in `CanonicalGaussians`."""

    offsets: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    fusion_weight: Tensor


class TexelMlp(nn.Module):
    """Three layers with SiLU between them."""

    def __init__(self, features: int, width: int) -> None:
        """`features` -> `width`."""
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        """[B,M,C] -> [B,M,W]."""
        return self.layers(x)


class Palette(nn.Module):
    """A few colours of the whole head: what is seen somewhere can be copied to where nothing was."""

    def __init__(self, features: int, count: int) -> None:
        """`features` channels of a texel decide for which of `count` colours it counts."""
        super().__init__()
        self.choose = nn.Linear(features, count)

    def forward(self, features: Tensor, observed: Tensor) -> Tensor:
        """Features [B,M,C], observed [B,M,4] -> weighted means [B,K,3] of the observed colours."""
        share = self.choose(features).add((observed[..., 3:] + _LEAST_SEEN).log()).softmax(dim=1)
        return share.mT @ observed[..., :3]


class AttributeHeads(nn.Module):
    """Linear layers `out_layers.{xyz,opacity,scaling,rotation,shs}`, all starting from the values in the config.

    Their weights start at zero, so every texel of the untrained model has the same shape: offset exactly 0, rotation
    the identity, scale exp(init_scale), opacity init_opacity. Only the colour layer reads the observation from the
    start.
    """

    def __init__(self, config: ModelConfig) -> None:
        """See `GaussianConfig` for ranges and initial values."""
        super().__init__()
        self.config = config.gaussians
        self.fusion = config.fusion
        self.aggregation = config.aggregation
        width = config.mlp_width
        sizes = {"xyz": 3, "opacity": 1, "scaling": 3, "rotation": 4}
        layers = {name: nn.Linear(width, size) for name, size in sizes.items()}
        self.palette = config.palette if config.aggregation else 0
        if self.palette:
            layers["mix"] = nn.Linear(width, self.palette + 1)
        layers["shs"] = nn.Linear(width + (4 if config.aggregation else 0), 4 if self._learned else 3)
        self.out_layers = nn.ModuleDict(layers)
        self._initialise()

    @property
    def _learned(self) -> bool:
        return self.aggregation and self.fusion == "learned"

    def _initialise(self) -> None:
        start = self.config
        biases = {
            "xyz": [0.0] * 3,
            "opacity": [math.log(start.init_opacity / (1 - start.init_opacity))],
            "scaling": [start.init_scale] * 3,
            "rotation": [1.0, 0.0, 0.0, 0.0],
        }
        if self.palette:
            biases["mix"] = [0.0] * self.palette + [_OWN]
        if start.fusion_bias is not None:
            middle = -_COLOR_GAIN / 2 if self.aggregation else 0.0
            biases["shs"] = [middle] * 3 + ([start.fusion_bias] if self._learned else [])
        with torch.no_grad():
            for name, bias in biases.items():
                layer = cast(nn.Linear, self.out_layers[name])
                nn.init.zeros_(layer.weight)
                layer.bias.copy_(torch.tensor(bias))
                if name == "shs" and self.aggregation:
                    layer.weight[:3, -4:-1] = _COLOR_GAIN * torch.eye(3)
                    layer.weight[3:, -1] = -start.fusion_trust

    def forward(
        self, features: Tensor, observed: Tensor, surface: SurfaceTexels, palette: Tensor | None = None
    ) -> Attributes:
        """features [B,M,W], observed [B,M,4] (aggregate colour and confidence at the texels), palette [B,K,3]."""
        out = self._linear(features)
        offsets = (torch.sigmoid(out["xyz"]) - 0.5) * 2 * self.config.offset_range
        opacities = torch.sigmoid(out["opacity"])[..., 0]
        least = self.config.least_scale
        scales = out["scaling"].clamp(math.log(least) if least else None, _MAX_LOG_SCALE).exp()
        quats = functional.normalize(out["rotation"], dim=-1)
        if self.config.relative:
            scales = scales * surface.scales
            quats = multiply_quaternions(surface.quats.expand_as(quats), quats)
        start = observed if palette is None else self._mixed(out["mix"], observed, palette)
        colors, weight = self._color(out["shs"], observed, start)
        return Attributes(offsets, quats, scales.clamp(0, self.config.scale_clip), opacities, colors, weight)

    def _linear(self, features: Tensor) -> dict[str, Tensor]:
        """All layers as one product, which reads the features once; `shs` still lacks the share of the observation."""
        layers = {name: cast(nn.Linear, layer) for name, layer in self.out_layers.items()}
        width = features.shape[-1]
        weight = torch.cat([layer.weight[:, :width] for layer in layers.values()])
        values = functional.linear(features, weight, torch.cat([layer.bias for layer in layers.values()]))
        parts = values.split([layer.out_features for layer in layers.values()], dim=-1)
        return dict(zip(layers, parts, strict=True))

    def _mixed(self, logits: Tensor, observed: Tensor, palette: Tensor) -> Tensor:
        """The observation [B,M,4] with each colour mixed from itself and the palette [B,K,3]."""
        share = logits.softmax(dim=-1)
        color = share[..., :-1] @ palette + share[..., -1:] * observed[..., :3]
        return torch.cat([color, observed[..., 3:]], dim=-1)

    def _color(self, values: Tensor, observed: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Self-adaptive fusion (paper eq. 9): predicted colour with share w, observed colour with share 1-w.

        `start` [B,M,4] is what the prediction starts from.
        """
        if not self.aggregation:
            predicted = torch.sigmoid(values)
            return predicted, torch.ones_like(predicted[..., 0])
        layer = cast(nn.Linear, self.out_layers["shs"])
        values = torch.sigmoid(values + functional.linear(start, layer.weight[:, -start.shape[-1] :]))
        weight = values[..., 3:] if self.fusion == "learned" else 0.5 * observed[..., 3:]
        return weight * values[..., :3] + (1 - weight) * observed[..., :3], weight[..., 0]
