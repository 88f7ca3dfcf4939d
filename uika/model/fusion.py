"""Encoder of both spaces: one backbone, one light fusion of its depths for the screen and one for UV (paper eq. 4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from uika.model.backbone import VisionTransformer, standardize
from uika.model.config import ModelConfig


class FusionHead(nn.Module):
    """Mixes the tapped depths with 1x1 convolutions; no activation, no norm."""

    def __init__(self, taps: int, backbone_dim: int, dim: int) -> None:
        """`taps` maps of `backbone_dim` channels -> `dim` channels."""
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(backbone_dim, backbone_dim, 1) for _ in range(taps))
        self.output_conv = nn.Conv2d(taps * backbone_dim, dim, 1)

    def forward(self, maps: tuple[Tensor, ...]) -> Tensor:
        """Maps [N,C,h,w] of all depths -> [N,D,h,w]."""
        projected = [project(features) for project, features in zip(self.projects, maps, strict=True)]
        return self.output_conv(torch.cat(projected, dim=1))


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

    def screen(self, images: Tensor) -> Tensor:
        """Photos [B,V,3,H,W] in [0,1] -> tokens of all views [B,V*L,D]."""
        return self._encode(images, self.fusion_head)

    def uv(self, images: Tensor) -> Tensor | None:
        """Reprojected images [B,V,3,H,W] -> tokens [B,V*L,D]; None without UV attention."""
        return None if self.uv_fusion_head is None else self._encode(images, self.uv_fusion_head)

    def _encode(self, images: Tensor, head: FusionHead) -> Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            maps = self.model(standardize(images.flatten(0, 1)))
        tokens = head(maps).flatten(2).transpose(1, 2)
        return tokens.reshape(images.shape[0], -1, tokens.shape[-1])
