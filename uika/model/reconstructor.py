"""Photos with pixel-to-UV maps in, canonical Gaussians out: the whole feed-forward model (paper section 3)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from uika.model.config import ModelConfig
from uika.model.dpt import UvDpt, resize
from uika.model.fusion import Encoder
from uika.model.gaussians import CanonicalGaussians, SurfaceTexels
from uika.model.heads import AttributeHeads, Attributes, TexelMlp
from uika.model.transformer import MMTransformer
from uika.uv import aggregate, fill, reproject


class Observation(NamedTuple):
    """What the photos say about the atlas."""

    color: Tensor  # [B,3,S,S] aggregate, completed where the config asks for it
    confidence: Tensor  # [B,1,S,S]
    views: Tensor  # [B,V,3,I,I] reprojected image of each view
    report: dict[str, int]


class GaussianDecoder(nn.Module):
    """Tokens and aggregate -> Gaussian attributes at the valid texels (paper eq. 8)."""

    def __init__(self, config: ModelConfig) -> None:
        """Sizes from `config`."""
        super().__init__()
        self.map_size = config.map_size
        self.dpt_decoder = UvDpt(config)
        self.mlp_net = TexelMlp(config.dpt_features, config.mlp_width)
        self.gs_net = AttributeHeads(config)

    def forward(self, tokens: list[Tensor], observed: Tensor, texel: Tensor, surface: SurfaceTexels) -> Attributes:
        """Tokens of four depths, observed [B,4,S,S], texel [M]."""
        features = resize(self.dpt_decoder(tokens, observed), (self.map_size, self.map_size))
        return self.gs_net(self.mlp_net(_gather(features, texel)), _gather(observed, texel), surface)


class Reconstructor(nn.Module):
    """The reconstruction network of one preset.

    With `gaussians.relative` (presets tiny and base) the last layers start at zero and predict residuals on the
    surface: before any training the result is the head surface itself, closed and opaque, wearing the photo colours.
    The paper's absolute start (small, nearly transparent Gaussians) only makes sense followed by its training.
    """

    def __init__(self, config: ModelConfig) -> None:
        """Random initialisation from the global generator; see `uika.model.build` for a seeded one."""
        super().__init__()
        self.config = config
        self.encoder = Encoder(config)
        self.transformer = MMTransformer(config)
        self.gs_decoder = GaussianDecoder(config)

    def forward(
        self,
        images: Tensor,
        masks: Tensor,
        pixel_uv: Tensor,
        pixel_weight: Tensor | None,
        texel: Tensor,
        surface: SurfaceTexels,
    ) -> CanonicalGaussians:
        """Reconstruct a batch of heads, each from V views.

        images        [B,V,3,H,W] in [0,1], background already replaced by one solid colour; any resolution
        masks         [B,V,1,H,W] foreground in [0,1]
        pixel_uv      [B,V,2,H,W] (u right, v down) in [0,1], NaN where a pixel shows no part of the head
        pixel_weight  [B,V,1,H,W] trust in each pixel's correspondence in [0,1], or None; the released arithmetic
                      (uv.grid "corners") counts every pixel once and takes no notice of it
        texel         [M] int64 row-major indices of the valid texels of the S*S atlas (S = config.map_size)
        surface       the canonical surface at those texels

        The report counts `views`, `empty_views` (no pixel reached the atlas), `texels`, `empty_texels` (valid texels
        that no pixel reached, summed over the batch) and `completed_texels` (those given a colour by mirror or
        diffusion). Raises ValueError for shapes that do not fit.
        """
        self._check(images, texel, surface)
        seen = self.observe(images, masks, pixel_uv, pixel_weight, texel, surface)
        size = (self.config.image_size, self.config.image_size)
        photos = resize(images.flatten(0, 1), size, antialias=True).unflatten(0, images.shape[:2])
        tokens = self.transformer(self.encoder.screen(photos), self.encoder.uv(seen.views))
        observed = torch.cat([seen.color, seen.confidence], dim=1)
        result = self.gs_decoder(tokens, observed, texel, surface)
        return CanonicalGaussians(
            means=surface.points + result.offsets,
            quats=result.quats,
            scales=result.scales,
            opacities=result.opacities,
            colors=result.colors,
            offsets=result.offsets,
            fusion_weight=result.fusion_weight,
            aggregate=seen.color,
            confidence=seen.confidence,
            report=seen.report,
        )

    @torch.no_grad()
    def observe(
        self,
        images: Tensor,
        masks: Tensor,
        pixel_uv: Tensor,
        pixel_weight: Tensor | None,
        texel: Tensor,
        surface: SurfaceTexels,
    ) -> Observation:
        """The part without learned weights: reprojection, aggregation and filling. Arguments as in `forward`."""
        config = self.config.uv
        weights = pixel_weight if config.grid == "centers" else None
        size = self.config.map_size
        valid = torch.zeros(size * size, dtype=torch.bool, device=images.device)
        valid[texel] = True
        valid = valid.reshape(size, size)
        pooled = aggregate(
            images,
            pixel_uv,
            masks,
            size,
            config.grid,
            weights,
            normalization=config.normalization,
            oversample=config.oversample,
            close_radius=config.close_radius,
            valid=valid,
        )
        views, view_hits = reproject(
            images,
            pixel_uv,
            masks,
            self.config.image_size,
            config.grid,
            weights,
            oversample=config.oversample,
            close_radius=config.close_radius,
        )
        empty = int(((pooled.hits <= 0) & valid).sum())
        color = pooled.rgb
        if config.fill:
            share = (pooled.trust / config.full_trust).clamp(0, 1)
            color = fill(color, share, valid, surface.mirror, regions=surface.regions, prior=surface.prior)
        report = {
            "views": images.shape[0] * images.shape[1],
            "empty_views": int((view_hits.amax(dim=(2, 3, 4)) <= 0).sum()),
            "texels": images.shape[0] * len(texel),
            "empty_texels": empty,
            "completed_texels": empty if config.fill else 0,
        }
        return Observation(color, pooled.confidence, views, report)

    def _check(self, images: Tensor, texel: Tensor, surface: SurfaceTexels) -> None:
        if images.ndim != 5 or images.shape[2] != 3 or images.shape[1] < 1:
            raise ValueError(f"images must be [B,V,3,H,W] with at least one view, got {list(images.shape)}")
        if not bool(torch.isfinite(images).all()):
            raise ValueError("images hold NaN or infinite values: every pixel, background included, needs a colour")
        if texel.ndim != 1 or texel.dtype != torch.int64:
            raise ValueError(f"texel must be int64 [M], got {texel.dtype} {list(texel.shape)}")
        size = self.config.map_size
        if len(texel) and (int(texel.min()) < 0 or int(texel.max()) >= size * size):
            raise ValueError(f"texel must index an atlas of {size}x{size} texels (config.map_size)")
        for name, channels in (("points", 3), ("quats", 4), ("scales", 3)):
            shape = getattr(surface, name).shape
            if len(shape) != 3 or shape[0] not in (1, len(images)) or tuple(shape[1:]) != (len(texel), channels):
                raise ValueError(f"surface.{name} must be [B or 1,{len(texel)},{channels}], got {list(shape)}")


def _gather(maps: Tensor, texel: Tensor) -> Tensor:
    """[B,C,S,S] at row-major texels [M] -> [B,M,C]."""
    return maps.flatten(2)[:, :, texel].transpose(1, 2)
