"""The same image in plain torch: what a machine without CUDA had so far.

The projection is gsplat's own torch function where gsplat 1.5.3 can be imported (it is written for tests; its tile
intersection is a Python loop and its scan needs CUDA). Tile intersection and blending are vectorised here: pairs of
every (16 x 16 tile, splat) are evaluated without gradients to find the (pixel, splat) pairs that count, and only those
go through autograd.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from drjit_splat import constants as c
from drjit_splat import reference
from drjit_splat._inputs import Splats
from drjit_splat._settings import Settings

TILE = 16
BATCH = 1 << 22  # pairs evaluated at once: their temporaries stay near the last-level cache


def has_gsplat() -> bool:
    """Whether gsplat's torch functions can be imported."""
    try:
        import gsplat.cuda._torch_impl  # noqa: F401
    except ImportError:
        return False
    return True


def project(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means on the image [N, 2], conics [N, 3], depths [N] and radii [N, 2] (0 where culled)."""
    if has_gsplat():
        from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

        covars, _ = _quat_scale_to_covar_preci(quats, scales, True, False)
        radii, means2d, depths, conics, _ = _fully_fused_projection(means, covars, viewmat[None], K[None], size, size)
        return means2d[0], conics[0], depths[0], radii[0]
    opaque = torch.ones_like(means[:, 0])
    splats = Splats(means, quats, scales, opaque, opaque[:, None], viewmat[None], K[None])
    p = reference.project(splats, viewmat, K, Settings(size, size))
    conics = torch.stack([p.covariance[:, 2], -p.covariance[:, 1], p.covariance[:, 0]], -1) / p.determinant[:, None]
    return p.means2d, conics, p.depths, p.radii


@torch.no_grad()
def tile_lists(means2d: Tensor, radii: Tensor, depths: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Splat ids tile by tile, near to far, and where each tile's begin [tiles + 1]."""
    across = -(-size // TILE)
    order = torch.argsort(depths.to(torch.float32).contiguous().view(torch.int32), stable=True)
    order = order[(radii[order] > 0).all(-1)]
    low = ((means2d[order] - radii[order]) / TILE).floor().long().clamp(0, across)
    high = ((means2d[order] + radii[order]) / TILE).ceil().long().clamp(0, across)
    spans = high - low
    counts = spans.prod(-1)
    splat = torch.repeat_interleave(torch.arange(len(order)), counts)
    local = torch.arange(len(splat)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    width = spans[splat, 0]
    tile = (low[splat, 1] + local // width) * across + low[splat, 0] + local % width
    tile, permutation = torch.sort(tile.int(), stable=True)
    start = torch.searchsorted(tile, torch.arange(across * across + 1, dtype=torch.int32))
    return order[splat[permutation]], start


def alphas(means2d: Tensor, conics: Tensor, opacities: Tensor, splat: Tensor, pixel: Tensor, size: int) -> Tensor:
    """Opacity of every pair, held at the largest."""
    dx = (pixel % size).to(means2d.dtype) + 0.5 - means2d[splat, 0]
    dy = torch.div(pixel, size, rounding_mode="floor").to(means2d.dtype) + 0.5 - means2d[splat, 1]
    a, b, d = conics[splat].unbind(-1)
    sigma = 0.5 * (a * dx * dx + d * dy * dy) + b * dx * dy
    return (opacities[splat] * torch.exp(-sigma)).clamp_max(c.ALPHA_MAX)


def transmittances(alpha: Tensor, pixel: Tensor) -> Tensor:
    """What each pair finds in front of it; a running product within each pixel.

    It is a difference of one long sum of logarithms, in float64 or it would drown.
    """
    logs = torch.log1p(-alpha.double())
    total = logs.cumsum(0) - logs
    first = torch.ones_like(pixel, dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    begin = first.nonzero()[:, 0][first.cumsum(0) - 1]
    return torch.exp(total - total[begin]).to(alpha.dtype)


@torch.no_grad()
def candidates(
    means2d: Tensor, conics: Tensor, opacities: Tensor, ids: Tensor, start: Tensor, size: int, least: float
) -> tuple[Tensor, Tensor]:
    """(splat, pixel) of every pair of at least about `least`, sorted by pixel and near to far within each."""
    across = -(-size // TILE)
    lengths = start[1:] - start[:-1]
    tiles = torch.argsort(lengths, descending=True)
    tiles = tiles[lengths[tiles] > 0]
    local = torch.arange(TILE * TILE)
    x, y = local % TILE + 0.5, torch.div(local, TILE, rounding_mode="floor") + 0.5
    # The exponent is quadratic in the pixel: one matrix product evaluates a whole tile.
    powers = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1).to(means2d.dtype)
    splats, pixels = [], []
    position = 0
    while position < len(tiles):
        longest = int(lengths[tiles[position]])
        batch = tiles[position : position + max(1, BATCH // (longest * TILE * TILE))]
        position += len(batch)
        entry = torch.arange(longest)
        splat = ids[(start[batch, None] + entry).clamp_max(len(ids) - 1)]  # [T, L]
        corner_x, corner_y = (batch % across) * TILE, torch.div(batch, across, rounding_mode="floor") * TILE
        mx, my = means2d[splat, 0] - corner_x[:, None], means2d[splat, 1] - corner_y[:, None]
        a, b, d = conics[splat].unbind(-1)
        constant = torch.log(opacities[splat]) - 0.5 * (a * mx * mx + d * my * my) - b * mx * my
        constant[entry >= lengths[batch, None]] = -torch.inf
        quadratic = torch.stack([constant, a * mx + b * my, d * my + b * mx, -0.5 * a, -b, -0.5 * d], 1)
        near = powers @ quadratic > math.log(least) - 1e-3  # [T, P, L]; the exact test follows
        tile, pixel, index = near.nonzero(as_tuple=True)
        column, row = corner_x[tile] + pixel % TILE, corner_y[tile] + torch.div(pixel, TILE, rounding_mode="floor")
        inside = (column < size) & (row < size)
        splats.append(splat[tile, index][inside])
        pixels.append((row * size + column)[inside])
    return torch.cat(splats), torch.cat(pixels)


@torch.no_grad()
def _pairs_that_count(
    means2d: Tensor, conics: Tensor, opacities: Tensor, ids: Tensor, start: Tensor, size: int
) -> tuple[Tensor, Tensor]:
    splat, pixel = candidates(means2d, conics, opacities, ids, start, size, c.ALPHA_MIN)
    alpha = alphas(means2d, conics, opacities, splat, pixel, size)
    hit = alpha >= c.ALPHA_MIN
    splat, pixel, alpha = splat[hit], pixel[hit], alpha[hit]
    keep = transmittances(alpha, pixel) * (1 - alpha) > c.T_MIN
    return splat[keep], pixel[keep]


def render(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    size: int,
) -> Tensor:
    """Image [size, size, D] over black by the first camera; differentiable by autograd."""
    means2d, conics, depths, radii = project(means, quats, scales, viewmats[0], Ks[0], size)
    ids, start = tile_lists(means2d.detach(), radii, depths.detach(), size)
    splat, pixel = _pairs_that_count(means2d.detach(), conics.detach(), opacities.detach(), ids, start, size)
    alpha = alphas(means2d, conics, opacities, splat, pixel, size)
    weight = alpha * transmittances(alpha, pixel)
    image = torch.zeros(size * size, colors.shape[1])
    return image.index_add(0, pixel, weight[:, None] * colors[splat]).view(size, size, -1)
