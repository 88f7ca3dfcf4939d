"""Photos with pixel-to-UV maps in, canonical Gaussians out: the whole feed-forward model (paper section 3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from uika.canonical.surface import SurfaceTexels
from uika.model.config import ModelConfig
from uika.model.decoder import GaussianDecoder
from uika.model.dpt import resize
from uika.model.fusion import Encoder
from uika.model.gaussians import CanonicalGaussians
from uika.model.observation import observe
from uika.model.precision import Precision, arithmetic, halve
from uika.model.transformer import ContextMemory, MMTransformer
from uika.model.view_features import EMPTY, FeatureCache, Keep, ViewFeatures, content_keys, covered_tokens, occupied
from uika.uv import Sums, accumulate, accumulate_sizes, view_images


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
        self.precision: Precision = "float32"
        self.encoder = Encoder(config)
        self.transformer = MMTransformer(config)
        self.gs_decoder = GaussianDecoder(config)

    def halve(self) -> None:
        """Store the weights in bfloat16 and compute in it where the device can; the per-texel MLP stays float32."""
        exempt = [part for part in self.gs_decoder.children() if part is not self.gs_decoder.dpt_decoder]
        halve(self, exempt=exempt)
        self.precision = "bfloat16"

    def forward(
        self,
        images: Tensor,
        masks: Tensor,
        pixel_uv: Tensor,
        pixel_weight: Tensor | None,
        texel: Tensor,
        surface: SurfaceTexels,
        keep: Keep = "all",
        cache: FeatureCache | None = None,
    ) -> CanonicalGaussians:
        """Reconstruct a batch of heads, each from V views.

        images        [B,V,3,H,W] in [0,1], background already replaced by one solid colour; any resolution
        masks         [B,V,1,H,W] foreground in [0,1]
        pixel_uv      [B,V,2,H,W] (u right, v down) in [0,1], NaN where a pixel shows no part of the head
        pixel_weight  [B,V,1,H,W] trust in each pixel's correspondence in [0,1], or None; the released arithmetic
                      (uv.grid "corners") counts every pixel once and takes no notice of it
        texel         [M] int64 row-major indices of the valid texels of the S*S atlas (S = config.map_size)
        surface       the canonical surface at those texels
        keep          "all" patches and tokens, or the "foreground", an approximation: left out are patches of photos
                      and of reprojected images of which less than an eighth shows the head, and tokens outside the
                      atlas
        cache         features of photos seen before, so that only new ones are encoded; results are the same

        The report counts `views`, `empty_views` (no pixel reached the atlas), `texels`, `empty_texels` (valid texels
        that no pixel reached, summed over the batch), `completed_texels` (those given a colour by mirror or
        diffusion), `patches` of photos and reprojected images, `skipped_patches`, `tokens`, `skipped_tokens` and
        `reused_views` (taken from the cache). Raises ValueError for shapes that do not fit.
        """
        self.check(images, texel, surface)
        reused = 0 if cache is None else -cache.hits
        items = self.encode(images, masks, pixel_uv, pixel_weight, keep, cache)
        reused += 0 if cache is None else cache.hits
        return self.decode(items, texel, surface, keep, reused)

    def encode(
        self,
        images: Tensor,
        masks: Tensor,
        pixel_uv: Tensor,
        pixel_weight: Tensor | None = None,
        keep: Keep = "all",
        cache: FeatureCache | None = None,
    ) -> list[list[ViewFeatures]]:
        """The features of every view of every item, each view by itself; arguments as in `forward`."""
        weights = pixel_weight if self.config.uv.grid == "centers" else None
        photos, mattes, coords = (value.flatten(0, 1)[:, None] for value in (images, masks, pixel_uv))
        trust = None if weights is None else weights.flatten(0, 1)[:, None]

        def screen(chosen: list[int] | slice) -> list[Tensor]:
            return self._screen(photos[chosen], mattes[chosen], keep)

        def atlas(chosen: list[int] | slice) -> list[tuple[Tensor | None, Sums]]:
            rows = (photos[chosen], mattes[chosen], coords[chosen], None if trust is None else trust[chosen])
            return self._atlas(*rows, keep)

        if cache is None:
            tokens, maps = screen(slice(None)), atlas(slice(None))
        else:
            seen = (photos, None if keep == "all" else mattes)
            tokens = cache.resolve("screen", content_keys(seen, keep), screen)
            maps = cache.resolve("atlas", content_keys((photos, mattes, coords, trust), keep), atlas)
        patch, (height, width) = self.config.backbone.patch_size, self.view_size(images)
        patches = (height // patch) * (width // patch) + (height // patch) ** 2 * self.config.uv_attention
        features = [ViewFeatures(photo, uv, sums, patches) for photo, (uv, sums) in zip(tokens, maps, strict=True)]
        return [features[first : first + images.shape[1]] for first in range(0, len(features), images.shape[1])]

    def decode(
        self,
        items: Sequence[Sequence[ViewFeatures]],
        texel: Tensor,
        surface: SurfaceTexels,
        keep: Keep = "all",
        reused: int = 0,
        memory: ContextMemory | None = None,
        newcomers: int | None = None,
    ) -> CanonicalGaussians:
        """Gaussians of B heads from the features of their views, which may come from different calls of `encode`.

        With `memory` only the last `newcomers` views pass the transformer; those before are read from the memory.
        """
        seen = [observe(self.config.uv, [view.sums for view in views], texel, surface) for views in items]
        color, confidence = torch.cat([each.color for each in seen]), torch.cat([each.confidence for each in seen])
        grid = self.config.token_grid
        kept = None if keep == "all" else covered_tokens(texel, self.config.map_size, grid)
        with arithmetic(self.precision, texel.device):
            tokens = self._attend([views[-(newcomers or 0) :] for views in items], kept, memory)
            observed = torch.cat([color, confidence], dim=1)
            known = torch.cat([each.known for each in seen])
            result = self.gs_decoder(tokens, observed, texel, surface, known)
        views = [view for item in items for view in item]
        used = sum(len(view.screen) + (0 if view.uv is None else len(view.uv)) for view in views)
        patches = sum(view.patches for view in views)
        report = {
            **{name: sum(each.report[name] for each in seen) for name in seen[0].report},
            "patches": patches,
            "skipped_patches": patches - used,
            "tokens": len(items) * grid**2,
            "skipped_tokens": 0 if kept is None else len(items) * int((~kept).sum()),
            "reused_views": reused,
        }
        return CanonicalGaussians(
            means=surface.points + result.offsets,
            quats=result.quats,
            scales=result.scales,
            opacities=result.opacities,
            colors=result.colors,
            offsets=result.offsets,
            fusion_weight=result.fusion_weight,
            aggregate=color,
            confidence=confidence,
            known=known,
            report=report,
        )

    @torch.no_grad()
    def sums(self, images: Tensor, masks: Tensor, pixel_uv: Tensor, pixel_weight: Tensor | None) -> list[Sums]:
        """What each view of one head adds to the aggregate [C,S,S]; arguments as in `forward`, B is 1."""
        config = self.config.uv
        weights = pixel_weight if config.grid == "centers" else None
        size = self.config.map_size
        sums = accumulate(images, pixel_uv, masks, size, config.grid, weights, oversample=config.oversample)
        return [Sums(*(part[0, view] for part in sums)) for view in range(images.shape[1])]

    def view_size(self, images: Tensor) -> tuple[int, int]:
        """Height and width at which the backbone sees photos [...,H,W]; reprojected ones are squares of the height."""
        side = self.config.image_size
        return (side, side) if side else (images.shape[-2], images.shape[-1])

    def _screen(self, images: Tensor, masks: Tensor, keep: Keep) -> list[Tensor]:
        """Tokens of photos [N,1,3,H,W]."""
        size = self.view_size(images)
        patch = self.config.backbone.patch_size
        kept = None if keep == "all" else occupied(masks[:, 0], (size[0] // patch, size[1] // patch), EMPTY)
        with arithmetic(self.precision, images.device):
            return self.encoder.screen(resize(images[:, 0], size, antialias=True), kept)

    def _atlas(
        self, images: Tensor, masks: Tensor, uv: Tensor, weights: Tensor | None, keep: Keep
    ) -> list[tuple[Tensor | None, Sums]]:
        """Tokens of the reprojected images of photos [N,1,3,H,W], and what each photo adds to the aggregate."""
        config, side = self.config.uv, self.view_size(images)[0]
        sizes = (self.config.map_size, side)
        sums, finer = accumulate_sizes(images, uv, masks, sizes, config.grid, weights, oversample=config.oversample)
        views, hits = view_images(finer, config.close_radius)
        grid = side // self.config.backbone.patch_size
        kept = None if keep == "all" else occupied(hits[:, 0] > 0, (grid, grid), EMPTY)
        with arithmetic(self.precision, images.device):
            tokens = self.encoder.uv(views[:, 0], kept)
        rows = [None] * len(images) if tokens is None else tokens
        return [(row, Sums(*(part[index, 0] for part in sums))) for index, row in enumerate(rows)]

    def _attend(
        self, items: Sequence[Sequence[ViewFeatures]], kept: Tensor | None, memory: ContextMemory | None
    ) -> list[Tensor]:
        """Tokens of the four depths; items of equal length pass together, others one by one without any padding."""
        screen = [torch.cat([view.screen for view in views]) for views in items]
        uv = [
            torch.cat([view.uv for view in views if view.uv is not None]) for views in items if views[0].uv is not None
        ]
        if len({(len(first), len(second)) for first, second in zip(screen, uv or screen, strict=True)}) == 1:
            return self.transformer(torch.stack(screen), torch.stack(uv) if uv else None, kept, memory)
        each = [
            self.transformer(first[None], uv[index][None] if uv else None, kept) for index, first in enumerate(screen)
        ]
        return [torch.cat(depth) for depth in zip(*each, strict=True)]

    def check(self, images: Tensor, texel: Tensor, surface: SurfaceTexels) -> None:
        """Raise ValueError for arguments of `forward` that do not fit."""
        if images.ndim != 5 or images.shape[2] != 3 or images.shape[1] < 1:
            raise ValueError(f"images must be [B,V,3,H,W] with at least one view, got {list(images.shape)}")
        patch = self.config.backbone.patch_size
        if not self.config.image_size and (images.shape[3] % patch or images.shape[4] % patch):
            raise ValueError(f"images must have sides that are multiples of {patch}, got {list(images.shape)}")
        # One bad value spoils the sum, which is quicker to find.
        if not bool(torch.isfinite(images.sum())) and not bool(torch.isfinite(images).all()):
            raise ValueError("images hold NaN or infinite values: every pixel, background included, needs a colour")
        if texel.ndim != 1 or texel.dtype != torch.int64:
            raise ValueError(f"texel must be int64 [M], got {texel.dtype} {list(texel.shape)}")
        needed = {"lift": self.config.surface, "shape": self.config.surface, "face": self.config.scope != "all"}
        for name, wanted in needed.items():
            if wanted and getattr(surface, name) is None:
                raise ValueError(f"surface.{name} is missing, which a model with this config needs")
        size = self.config.map_size
        if len(texel) and (int(texel.min()) < 0 or int(texel.max()) >= size * size):
            raise ValueError(f"texel must index an atlas of {size}x{size} texels (config.map_size)")
        for name, channels in (("points", 3), ("quats", 4), ("scales", 3)):
            shape = getattr(surface, name).shape
            if len(shape) != 3 or shape[0] not in (1, len(images)) or tuple(shape[1:]) != (len(texel), channels):
                raise ValueError(f"surface.{name} must be [B or 1,{len(texel)},{channels}], got {list(shape)}")
