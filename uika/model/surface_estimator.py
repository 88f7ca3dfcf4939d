"""A small correspondence estimator for CPUs: a convolutional network that places each pixel on the mean head.

Its job is that of the paper's estimator (section 3.1, supplement A.1), its shape is not: photos are seen one by one at
128 pixels, and what is predicted are codes of the surface (`uika.model.surface_codes`), from which UV coordinates
follow, so that seams of the atlas blur nothing. Beside them stand how far off a pixel's place may be, whether it shows
the head at all, and whether it shows hair.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.model.config import SurfaceEstimatorConfig
from uika.model.surface_codes import CODE, UNIT, SurfaceTable, UvLookup

NEAR = 0.0065  # metres, about 6 texels of 384: confidence is the chance of being closer than that
_LEAST_CONFIDENCE = 0.02  # pixels below it get no UV coordinate
_SPREAD = (-7.0, 1.0)  # logarithms of the smallest and largest error scale, code units


class SurfaceMaps(NamedTuple):
    """What the network says of B pictures, at its own resolution L = half its input's side."""

    code: Tensor  # [B,4,L,L]
    spread: Tensor  # [B,L,L] logarithm of the scale of the code's error
    head: Tensor  # [B,L,L] logit: the pixel shows the head
    hair: Tensor  # [B,L,L] logit: what it shows of the head is hair


class Correspondence(NamedTuple):
    """What the pixels of V views of B heads show."""

    uv: Tensor  # [B,V,2,H,W] in [0,1], v down; NaN where the confidence is below 0.02
    confidence: Tensor  # [B,V,H,W] in [0,1], the estimated chance that the place is right within 6.5 mm
    hair: Tensor  # [B,V,H,W] in [0,1], how likely the pixel shows hair


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _layer(width, width), _layer(width, width, active=False)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


class SurfaceNetwork(nn.Module):
    """Encoder and decoder with skips; half the input's resolution comes out."""

    def __init__(self, config: SurfaceEstimatorConfig) -> None:
        """See `SurfaceEstimatorConfig`."""
        super().__init__()
        widths = config.widths
        self.stem = _layer(3, widths[0], stride=2)
        self.down = nn.ModuleList(_layer(a, b, stride=2) for a, b in pairwise(widths))
        self.stages = nn.ModuleList(
            nn.Sequential(*(_Residual(width) for _ in range(count)))
            for width, count in zip(widths, config.blocks, strict=True)
        )
        self.up = nn.ModuleList(_layer(a + b, a) for a, b in pairwise(widths))
        self.out = nn.Conv2d(widths[0], CODE + 3, 1)

    def forward(self, images: Tensor) -> SurfaceMaps:
        """Pictures [B,3,S,S] in [0,1] with S a multiple of the smallest grid's pixels."""
        x = self.stages[0](self.stem((images - 0.5) / 0.25))
        skips = [x]
        for down, stage in zip(self.down, list(self.stages)[1:], strict=True):
            x = stage(down(x))
            skips.append(x)
        for level in reversed(range(len(self.up))):
            wide = functional.interpolate(x, size=skips[level].shape[-2:], mode="nearest")
            x = self.up[level](torch.cat((skips[level], wide), 1))
        code, spread, head, hair = self.out(x).split((CODE, 1, 1, 1), dim=1)
        return SurfaceMaps(code, spread[:, 0].clamp(*_SPREAD), head[:, 0], hair[:, 0])


class SurfaceEstimator(nn.Module):
    """The network and the surface of the head that it was trained for."""

    def __init__(self, config: SurfaceEstimatorConfig, table: SurfaceTable) -> None:
        """Random initialisation from the global generator."""
        super().__init__()
        self.config = config
        self.network = SurfaceNetwork(config)
        for name, value in zip(SurfaceTable._fields, table, strict=True):
            self.register_buffer(f"table_{name}", value)
        self._lookup: UvLookup | None = None

    def forward(self, images: Tensor) -> Tensor:
        """Photos [B,V,3,H,W] in [0,1] on a solid background -> UV maps [B,V,2,H,W], (u right, v down).

        NaN where nothing of the head is seen. Raises ValueError for a shape that does not fit.
        """
        return self.observe(images).uv

    @torch.no_grad()
    def observe(self, images: Tensor) -> Correspondence:
        """The same with the confidence in it and what is hair; H = W, of any size."""
        if images.ndim != 5 or images.shape[2] != 3 or images.shape[3] != images.shape[4]:
            raise ValueError(f"images must be [B,V,3,S,S], got {list(images.shape)}")
        side = images.shape[-1]
        batch, views = images.shape[:2]
        seen = torch.cat([self._maps(image[None], side) for image in images.flatten(0, 1)])
        code, spread, head, hair = seen.split((CODE, 1, 1, 1), dim=1)
        confidence = head.sigmoid()[:, 0] * chance_within(NEAR / UNIT, spread[:, 0])
        known = confidence > _LEAST_CONFIDENCE
        if self._lookup is None:
            parts = (self.get_buffer(f"table_{name}").float().cpu() for name in SurfaceTable._fields)
            self._lookup = UvLookup(SurfaceTable(*parts))
        places, away = self._lookup(code.permute(0, 2, 3, 1)[known].float().cpu())
        uv = torch.full((*known.shape, 2), torch.nan, device=images.device)
        uv[known] = places.to(images.device)
        # A mean of two surfaces, at the rim of one before the other, lies on neither.
        confidence = confidence.clone()
        confidence[known] *= (1 - (away.to(images.device) / NEAR - 0.5)).clamp(0, 1)
        shape = (batch, views)
        return Correspondence(
            uv.permute(0, 3, 1, 2).unflatten(0, shape),
            (confidence * known).unflatten(0, shape),
            hair.sigmoid()[:, 0].unflatten(0, shape),
        )

    def _maps(self, image: Tensor, side: int) -> Tensor:
        """Codes, error scales and logits [1,7,side,side] of a picture [1,3,side,side]."""
        size = (self.config.size, self.config.size)
        small = functional.interpolate(image, size=size, mode="bilinear", antialias=True, align_corners=False)
        maps = self.network(small)
        layers = torch.cat((maps.code, *(part[:, None] for part in maps[1:])), 1)
        return functional.interpolate(layers, size=(side, side), mode="bilinear", align_corners=False)


def chance_within(distance: float, spread: Tensor) -> Tensor:
    """Chance that an error is below `distance`, for errors on a surface that fall off as exp(-e / exp(spread))."""
    ratio = distance * (-spread).exp()
    return 1 - (1 + ratio) * (-ratio).exp()


def _layer(before: int, after: int, stride: int = 1, active: bool = True) -> nn.Sequential:
    parts: list[nn.Module] = [nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after)]
    return nn.Sequential(*parts, *([nn.ReLU(inplace=True)] if active else []))
