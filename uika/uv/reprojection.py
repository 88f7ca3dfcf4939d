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
    results = []
    # One by one, so that the steps find a view in the processor's cache.
    for color, weight in zip(sums.color.flatten(0, 1), sums.weight.flatten(0, 1), strict=True):
        image, hits = mean_color(color, weight)[None].float(), weight[None].float()
        results.append(close_holes(image, hits, radius=close_radius) if close_radius > 0 else (image, hits))
    images, weights = (torch.cat(parts).unflatten(0, sums.weight.shape[:2]) for parts in zip(*results, strict=True))
    return images, weights


def mean_color(color: Tensor, weight: Tensor) -> Tensor:
    """Sums [...,3,S,S] over weights [...,1,S,S]; exactly 0 where the weight is 0, as the sums are there."""
    return color / weight.clamp_min(1e-300)


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
    scratch = torch.empty(5 * images.shape[3] * images.shape[4], dtype=torch.float64, device=images.device)
    for view in range(batch * views):
        item, index = divmod(view, views)
        trust = None if weights is None else weights[item, index]
        table = _table(images[item, index], uv[item, index], masks[item, index], grid, trust)
        table[2:] /= oversample**2
        for sample in _samples(table, oversample):
            payload = scratch[: sample[2:].numel()].view(5, -1).copy_(sample[2:].flatten(1))
            for size, total in zip(sizes, totals, strict=True):
                total[view].scatter_add_(1, _cells(sample[:2], size, grid).expand(5, -1), payload)
    maps = [total.view(batch, views, 5, size, size) for size, total in zip(sizes, totals, strict=True)]
    return [Sums(color=parts[:, :, :3], weight=parts[:, :, 3:4], samples=parts[:, :, 4:5]) for parts in maps]


def _table(image: Tensor, uv: Tensor, mask: Tensor, grid: Grid, weight: Tensor | None) -> Tensor:
    """Rows (u, v, weighted r, g, b, weight, 1) [7,h,w] of one view, cropped to the pixels that count.

    Pixels inside the crop that do not count carry 0 in the last five rows.
    """
    share = mask.float() if grid == "centers" else (mask > 0).float()
    if weight is not None:
        share = share * weight
    coords = uv.float() if grid == "centers" else uv.float().clamp(0, 1)
    low, high = coords.aminmax(dim=0)
    valid = (share[0] > 0) & (low >= 0) & (high <= 1)
    rows, columns = (_extent(valid.any(dim=axis)) for axis in (1, 0))
    share, coords = share[:, rows, columns], coords[:, rows, columns]
    # Colours are premultiplied so that samples between two pixels follow the trusted one.
    table = torch.cat([coords, image[:, rows, columns].float() * share, share, torch.ones_like(share)])
    valid = valid[rows, columns] & torch.isfinite(table[2:6]).all(dim=0)
    # Each goes to another texel: sums of zeros into a single one would wait for each other.
    away = torch.stack(torch.meshgrid(*(torch.linspace(0, 1, n) for n in valid.shape), indexing="ij"))
    table[:2] = torch.where(valid, table[:2], away.to(table.device).flip(0))
    table[2:].masked_fill_(~valid, 0.0)
    return table


def _extent(used: Tensor) -> slice:
    """From the first to the last True of [L]."""
    places = used.nonzero()
    return slice(int(places[0]), int(places[-1]) + 1) if len(places) else slice(0)


def _cells(uv: Tensor, size: int, grid: Grid) -> Tensor:
    """Row-major texels [h*w] of uv [2,h,w]."""
    # The conversion cuts off the fraction, which rounds down as nothing is negative.
    place = (uv * size).clamp_max_(size - 1) if grid == "centers" else torch.round(uv * (size - 1))
    column, row = place.long()
    return (row * size + column).flatten()


def _samples(table: Tensor, oversample: int) -> Iterator[Tensor]:
    """Yield interpolated rows [7,h,w] for each of the k*k positions inside the pixels' cells.

    A sample may take the memory of the one before.
    """
    yield table
    if oversample == 1 or 0 in table.shape:
        return
    right, down, across = table[:, :, 1:], table[:, 1:], table[:, 1:, 1:]
    beside, below = _linked(table, right), _linked(table, down)
    inside = beside[:-1] & below[:, :-1] & _linked(table, across)
    room = torch.empty(table.numel(), device=table.device)
    fractions = [step / oversample for step in range(1, oversample)]
    for fraction in fractions:
        yield _between(table, right, fraction, beside, room)
        yield _between(table, down, fraction, below, room)
    for x in fractions:
        edges = torch.lerp(table[:, :, :-1], right, x)
        for y in fractions:
            yield _between(edges, edges[:, 1:], y, inside, room)


def _linked(table: Tensor, other: Tensor) -> Tensor:
    """Whether pixels of a table and those of its shifted copy both count and lie close in UV."""
    here = table[:, : other.shape[1], : other.shape[2]]
    step = (other[:2] - here[:2]).abs_().amax(dim=0)
    return (step <= MAX_UV_STEP) & (here[6] > 0) & (other[6] > 0)


def _between(table: Tensor, other: Tensor, fraction: float, linked: Tensor, room: Tensor) -> Tensor:
    """On the way from a table to its shifted copy; pixels that are not linked carry nothing. Lies in `room`."""
    sample = room[: other.numel()].view(other.shape)
    torch.lerp(table[:, : other.shape[1], : other.shape[2]], other, fraction, out=sample)
    sample[2:] *= linked
    return sample


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
