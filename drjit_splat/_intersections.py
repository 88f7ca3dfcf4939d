"""gsplat's lists of (tile, splat) intersections, for programs that read them; the kernels have their own lists."""

from __future__ import annotations

import torch
from torch import Tensor


def intersections(
    means2d: Tensor,  # [M, 2] pixels
    radii: Tensor,  # [M, 2] pixels
    depths: Tensor,  # [M]
    images: Tensor,  # [M] int64, ascending
    n_images: int,
    tile_size: int,
    grid: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which square tiles the bounding boxes of M splats touch.

    Returns:
        tiles_per_gauss [M] int32; isect_ids [P] int64, ascending (image, tile, bits of the depth, from the top);
        flatten_ids [P] int32, the splat of each; and isect_offsets [I, rows, columns] int32, where each tile's begin.
    """
    columns, rows = grid
    size = torch.tensor([columns, rows], device=means2d.device)
    first = torch.clamp(torch.floor((means2d - radii) / tile_size).long(), min=torch.zeros_like(size), max=size)
    last = torch.clamp(torch.ceil((means2d + radii) / tile_size).long(), min=torch.zeros_like(size), max=size)
    extent = (last - first) * (radii > 0).all(-1, keepdim=True)
    counts = extent.prod(-1)
    splat = torch.repeat_interleave(counts)
    place = torch.arange(len(splat), device=splat.device) - (torch.cumsum(counts, 0) - counts)[splat]
    width = extent[splat, 0]
    down = torch.div(place, width, rounding_mode="floor")
    tile = (first[splat, 1] + down) * columns + first[splat, 0] + place - down * width
    bits = (columns * rows).bit_length()
    depth = depths.contiguous().view(torch.int32).long() & 0xFFFFFFFF
    ids, order = torch.sort((((images[splat] << bits) | tile) << 32) | depth[splat], stable=True)
    offsets = torch.bincount(images[splat] * (columns * rows) + tile, minlength=n_images * columns * rows)
    offsets = torch.cumsum(offsets, 0) - offsets
    return counts.int(), ids, splat[order].int(), offsets.int().view(n_images, rows, columns)
