"""Scatter of photo pixels into the UV atlas along a pixel-to-UV map (paper section 3.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    return view_images(accumulate(images, uv, masks, size, grid, weights, oversample=oversample), close_radius)


def view_images(sums: Sums, close_radius: int = 0) -> tuple[Tensor, Tensor]:
    """The result of `reproject` from the sums of `accumulate`."""
    batch, views = sums.weight.shape[:2]
    colors = mean_color(sums.color, sums.weight).flatten(0, 1).float()
    weight = sums.weight.flatten(0, 1).float()
    if close_radius > 0:
        colors, weight = close_holes(colors, weight, radius=close_radius)
    return colors.unflatten(0, (batch, views)), weight.unflatten(0, (batch, views))


def mean_color(color: Tensor, weight: Tensor) -> Tensor:
    """Sums [...,3,S,S] over weights [...,1,S,S]; exactly 0 where the weight is 0."""
    return torch.where(weight > 0, color / weight.clamp_min(1e-300), torch.zeros_like(color))


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
    return accumulate_sizes(images, uv, masks, (size,), grid, weights, oversample=oversample)[0]


@torch.no_grad()
def accumulate_sizes(
    images: Tensor,
    uv: Tensor,
    masks: Tensor,
    sizes: Sequence[int],
    grid: Grid = "centers",
    weights: Tensor | None = None,
    *,
    oversample: int = 1,
) -> list[Sums]:
    """`accumulate` for several atlas sizes in one pass over the pixels."""
    _check(images, uv, masks, min(sizes), grid, weights, oversample)
    batch, views = images.shape[:2]
    totals = [torch.zeros(batch * views, 5, size * size, dtype=torch.float64, device=images.device) for size in sizes]
    for view in range(batch * views):
        item, index = divmod(view, views)
        trust = None if weights is None else weights[item, index]
        table, valid = _table(images[item, index], uv[item, index], masks[item, index], grid, trust)
        for sample in _samples(table, valid, oversample):
            payload = torch.cat([sample[2:], torch.ones_like(sample[:1])]).double() / oversample**2
            for size, total in zip(sizes, totals, strict=True):
                total[view].scatter_add_(1, _cells(sample[:2], size, grid).expand(5, -1), payload)
    maps = [total.view(batch, views, 5, size, size) for size, total in zip(sizes, totals, strict=True)]
    return [Sums(color=parts[:, :, :3], weight=parts[:, :, 3:4], samples=parts[:, :, 4:5]) for parts in maps]


def _table(image: Tensor, uv: Tensor, mask: Tensor, grid: Grid, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    """Rows (u, v, weighted r, g, b, weight) [6,H,W] of one view, and which pixels count [H,W]."""
    share = mask.float() if grid == "centers" else (mask > 0).float()
    if weight is not None:
        share = share * weight
    coords = uv.float() if grid == "centers" else uv.float().clamp(0, 1)
    # Colours are premultiplied so that samples between two pixels follow the trusted one.
    table = torch.cat([coords, image.float() * share, share])
    valid = torch.isfinite(table).all(dim=0) & (share[0] > 0) & ((coords >= 0) & (coords <= 1)).all(dim=0)
    return table, valid


def _cells(uv: Tensor, size: int, grid: Grid) -> Tensor:
    """Row-major texel of uv [2,P]."""
    if grid == "centers":
        column_row = (uv * size).floor().long().clamp_(0, size - 1)
    else:
        column_row = torch.round(uv * (size - 1)).long()
    return column_row[1] * size + column_row[0]


def _samples(table: Tensor, valid: Tensor, oversample: int) -> Iterator[Tensor]:
    """Yield interpolated columns [6,P] for each of the k*k positions inside the pixels' cells."""
    height, width = valid.shape
    flat, usable = table.flatten(1), valid.flatten()
    pixel = usable.nonzero()[:, 0]
    here = flat.index_select(1, pixel)
    yield here
    if oversample == 1:
        return
    column, row = pixel % width, torch.div(pixel, width, rounding_mode="floor")
    inside = {1: column < width - 1, width: row < height - 1}
    inside[width + 1] = inside[1] & inside[width]
    linked = {}
    for step, exists in inside.items():
        other = torch.where(exists, pixel + step, pixel)
        there = flat.index_select(1, other)
        close = (there[:2] - here[:2]).abs().amax(dim=0) <= MAX_UV_STEP
        linked[step] = exists & usable.index_select(0, other) & close
    right, down = (linked[step].nonzero()[:, 0] for step in (1, width))
    cell = (linked[1] & linked[width] & linked[width + 1]).nonzero()[:, 0]
    fractions = [step / oversample for step in range(1, oversample)]
    for chosen, step in ((right, 1), (down, width)):
        start, end = here.index_select(1, chosen), flat.index_select(1, pixel[chosen] + step)
        yield from (torch.lerp(start, end, fraction) for fraction in fractions)
    corners = [flat.index_select(1, pixel[cell] + step) for step in (0, 1, width, width + 1)]
    for x in fractions:
        top, bottom = torch.lerp(corners[0], corners[1], x), torch.lerp(corners[2], corners[3], x)
        yield from (torch.lerp(top, bottom, y) for y in fractions)


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
