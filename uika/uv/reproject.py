"""Scatter of photo pixels into the UV atlas along a pixel-to-UV map (paper section 3.1)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from uika.uv.holes import close_holes

Grid = Literal["centers", "corners"]

# Two neighbouring pixels farther apart than this in UV lie on different charts or across an occlusion edge.
MAX_UV_STEP = 0.0125


class Sums(NamedTuple):
    """What each texel received, per view; float64 so that the order of pixels and views cannot matter."""

    color: Tensor  # [B,V,3,S,S] sum of weight * colour
    weight: Tensor  # [B,V,1,S,S] sum of weights, in pixels
    samples: Tensor  # [B,V,1,S,S] number of samples, in pixels


def reproject(
    images: Tensor,
    uv: Tensor,
    masks: Tensor,
    size: int,
    grid: Grid = "centers",
    weights: Tensor | None = None,
    *,
    oversample: int = 1,
    close_radius: int = 0,
) -> tuple[Tensor, Tensor]:
    """Reprojected image of every view: the mean colour of the pixels that fall on each texel (paper eq. 2).

    Arguments as in `accumulate`; `close_radius` (texels) closes pinholes with `close_holes`.
    Returns colours [B,V,3,S,S] (0 where nothing was hit) and the hit weight [B,V,1,S,S] in pixels, both float32.
    """
    sums = accumulate(images, uv, masks, size, grid, weights, oversample=oversample)
    batch, views = images.shape[:2]
    colors = mean_color(sums.color, sums.weight).flatten(0, 1).float()
    weight = sums.weight.flatten(0, 1).float()
    if close_radius > 0:
        colors, weight = close_holes(colors, weight, radius=close_radius)
    return colors.unflatten(0, (batch, views)), weight.unflatten(0, (batch, views))


def mean_color(color: Tensor, weight: Tensor) -> Tensor:
    """Sums [...,3,S,S] over weights [...,1,S,S]; exactly 0 where the weight is 0."""
    return torch.where(weight > 0, color / weight.clamp_min(1e-300), torch.zeros_like(color))


@torch.no_grad()
def accumulate(
    images: Tensor,
    uv: Tensor,
    masks: Tensor,
    size: int,
    grid: Grid = "centers",
    weights: Tensor | None = None,
    *,
    oversample: int = 1,
) -> Sums:
    """Sum the pixels of every view into its own atlas.

    images   [B,V,3,H,W]  colours in [0,1]
    uv       [B,V,2,H,W]  (u right, v down) in [0,1]; pixels with a NaN or infinite value are ignored
    masks    [B,V,1,H,W]  foreground in [0,1]; pixels at 0 are ignored
    size                  atlas side S in texels
    grid                  "centers": col = floor(u*S), uv outside [0,1] ignored, soft masks weigh softly;
                          "corners": the released arithmetic, col = round(u*(S-1)), uv clamped, each pixel counts 1
    weights  [B,V,1,H,W]  optional trust in each pixel (grazing angle, visibility), >= 0, only with "centers"
    oversample            k: between neighbouring pixels that lie close in UV, k*k bilinear samples per pixel, each
                          with 1/k^2 of its weight, so that a photo coarser than the atlas leaves fewer pinholes

    No gradient flows through it. Raises ValueError on shapes, sizes or options that do not fit.
    """
    _check(images, uv, masks, size, grid, weights, oversample)
    batch, views, _, height, width = images.shape
    weight = masks.float() if grid == "centers" else (masks > 0).float()
    if weights is not None:
        weight = weight * weights
    coords = uv.float() if grid == "centers" else uv.float().clamp(0, 1)
    # Colours are premultiplied so that samples between two pixels follow the trusted one.
    table = torch.cat([coords, images.float() * weight, weight], dim=2)
    valid = torch.isfinite(table).all(dim=2) & (weight[:, :, 0] > 0)
    valid &= ((coords >= 0) & (coords <= 1)).all(dim=2)
    table = table.permute(0, 1, 3, 4, 2).reshape(-1, 6)

    out = torch.zeros(batch * views * size * size, 5, dtype=torch.float64, device=images.device)
    for pixel, sample in _samples(table, valid.reshape(-1, height, width), oversample):
        view = pixel // (height * width)
        cells = _cells(sample[:, :2], size, grid)
        payload = torch.cat([sample[:, 2:].double(), torch.ones_like(sample[:, :1])], dim=1) / oversample**2
        out.index_add_(0, view * size * size + cells, payload)
    maps = out.reshape(batch, views, size, size, 5).permute(0, 1, 4, 2, 3)
    return Sums(color=maps[:, :, :3], weight=maps[:, :, 3:4], samples=maps[:, :, 4:5])


def _cells(uv: Tensor, size: int, grid: Grid) -> Tensor:
    """Row-major texel of uv [P,2]."""
    if grid == "centers":
        column_row = (uv * size).floor().long().clamp_(0, size - 1)
    else:
        column_row = torch.round(uv * (size - 1)).long()
    return column_row[:, 1] * size + column_row[:, 0]


def _samples(table: Tensor, valid: Tensor, oversample: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield (pixel index [P], interpolated rows [P,6]) for each of the k*k positions inside a pixel's cell."""
    _, height, width = valid.shape
    flat = valid.reshape(-1)
    pixel = flat.nonzero()[:, 0]
    yield pixel, table[pixel]
    if oversample == 1:
        return
    right_ok = _linked(table, flat, pixel, 1, pixel % width < width - 1)
    down_ok = _linked(table, flat, pixel, width, pixel // width % height < height - 1)
    cell_ok = right_ok & down_ok
    cell_ok[cell_ok.clone()] = _linked(table, flat, pixel[cell_ok], width + 1, torch.ones_like(pixel[cell_ok]) > 0)
    right, down, cell = pixel[right_ok], pixel[down_ok], pixel[cell_ok]
    corners = [table[cell], table[cell + 1], table[cell + width], table[cell + width + 1]]
    fractions = [step / oversample for step in range(1, oversample)]
    for x in fractions:
        yield right, torch.lerp(table[right], table[right + 1], x)
        yield down, torch.lerp(table[down], table[down + width], x)
        for y in fractions:
            top = torch.lerp(corners[0], corners[1], x)
            bottom = torch.lerp(corners[2], corners[3], x)
            yield cell, torch.lerp(top, bottom, y)


def _linked(table: Tensor, valid: Tensor, pixel: Tensor, step: int, inside: Tensor) -> Tensor:
    """Whether the pixel `step` further exists, is valid and lies close in UV."""
    other = torch.where(inside, pixel + step, pixel)
    close = (table[other, :2] - table[pixel, :2]).abs().amax(dim=1) <= MAX_UV_STEP
    return inside & valid[other] & close


def _check(
    images: Tensor, uv: Tensor, masks: Tensor, size: int, grid: str, weights: Tensor | None, oversample: int
) -> None:
    if images.ndim != 5 or images.shape[2] != 3:
        raise ValueError(f"images must be [B,V,3,H,W], got {list(images.shape)}")
    batch, views, _, height, width = images.shape
    for name, value, channels in (("uv", uv, 2), ("masks", masks, 1), ("weights", weights, 1)):
        expected = [batch, views, channels, height, width]
        if value is not None and list(value.shape) != expected:
            raise ValueError(f"{name} must be {expected} to match images, got {list(value.shape)}")
    if grid not in ("centers", "corners"):
        raise ValueError(f'grid must be "centers" or "corners", got {grid!r}')
    if grid == "corners" and (weights is not None or oversample != 1):
        raise ValueError('grid "corners" counts every pixel once: leave weights and oversample at their defaults')
    if size < 1 or oversample < 1:
        raise ValueError(f"size and oversample must be at least 1, got {size} and {oversample}")
