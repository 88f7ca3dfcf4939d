"""Encoder of both spaces: one backbone, one light fusion of its depths for the screen and one for UV (paper eq. 4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.model.backbone import VisionTransformer, standardize
from uika.model.config import ModelConfig

_VIEWS_AT_ONCE = 8  # without gradients; bounds memory, changes no value


class FusionHead(nn.Module):
    """Mixes the tapped depths with 1x1 convolutions; no activation, no norm."""

    def __init__(self, taps: int, backbone_dim: int, dim: int) -> None:
        """`taps` maps of `backbone_dim` channels -> `dim` channels."""
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(backbone_dim, backbone_dim, 1) for _ in range(taps))
        self.output_conv = nn.Conv2d(taps * backbone_dim, dim, 1)

    def forward(self, taps: tuple[Tensor, ...]) -> Tensor:
        """Tokens [...,L,C] of all depths -> [...,L,D]."""
        projected = [_pointwise(project, tap) for project, tap in zip(self.projects, taps, strict=True)]
        return _pointwise(self.output_conv, torch.cat(projected, dim=-1))


def _pointwise(layer: nn.Module, tokens: Tensor) -> Tensor:
    """A 1x1 convolution of tokens [...,C]."""
    assert isinstance(layer, nn.Conv2d)
    return functional.linear(tokens, layer.weight.flatten(1), layer.bias)


class Encoder(nn.Module):
    """Features of photos (screen) and of their reprojected images (UV)."""

    def __init__(self, config: ModelConfig) -> None:
        """Builds the UV head only if the config has UV attention."""
        super().__init__()
        backbone = config.backbone
        self.frozen = backbone.frozen
        self.model = VisionTransformer(backbone)
        self.fusion_head = FusionHead(len(backbone.taps), backbone.dim, config.dim)
        self.uv_fusion_head = FusionHead(len(backbone.taps), backbone.dim, config.dim) if config.uv_attention else None

    def screen(self, images: Tensor, keep: Tensor | None = None) -> list[Tensor]:
        """Photos [N,3,H,W] in [0,1] -> tokens of each, [h*w,D], or of the patches in keep [N,h*w] alone."""
        return self._encode(images, keep, self.fusion_head)

    def uv(self, images: Tensor, keep: Tensor | None = None) -> list[Tensor] | None:
        """Reprojected images [N,3,S,S] likewise; None without UV attention."""
        return None if self.uv_fusion_head is None else self._encode(images, keep, self.uv_fusion_head)

    def _encode(self, images: Tensor, keep: Tensor | None, head: FusionHead) -> list[Tensor]:
        learning = torch.is_grad_enabled()
        results: list[Tensor] = []
        step = len(images) if learning else _VIEWS_AT_ONCE
        for first in range(0, len(images), step):
            part = standardize(images[first : first + step])
            with torch.set_grad_enabled(learning and not self.frozen):
                taps = [self.model(part)] if keep is None else self.model.kept(part, keep[first : first + step])
            results += head(taps[0]).unbind(0) if keep is None else [head(each) for each in taps]
        return results
