"""A float64 oracle for large scenes: `drjit_splat.reference` restricted to the (pixel, splat) pairs that can count.

The reference evaluates every pair, which is out of reach at 130,000 splats; here pairs below a tenth of the threshold
are left out, and the rest is the reference's own projection and the same arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks import torch_baseline as pairs
from benchmarks.splat_scenes import Scene
from drjit_splat import constants as c
from drjit_splat import reference
from drjit_splat._inputs import Splats
from drjit_splat._settings import Settings


@dataclass(frozen=True)
class Exact:
    """Image, coverage and how far every pixel's decisions lie from their thresholds (relatively)."""

    image: Tensor  # [H, W, D]
    alpha: Tensor  # [H, W]
    margin: Tensor  # [H, W]


def render(scene: Scene, tensors: list[Tensor], ranks: Tensor, skips: bool = True) -> Exact:
    """The scene in float64.

    Args:
        scene: its cameras and size are used.
        tensors: float64 means, quats, scales, opacities and colours; autograd reaches them.
        ranks: [N] numbers that increase with depth, ties broken by id (the float32 depths of the tested code).
        skips: False keeps every pair above 1e-7 and never stops a pixel.
    """
    size = scene.size
    means, quats, scales, opacities, colors = tensors
    viewmat, K = scene.viewmats[0].double(), scene.Ks[0].double()
    splats = Splats(means, quats, scales, opacities, colors, viewmat[None], K[None])
    p = reference.project(splats, viewmat, K, Settings(size, size))
    conics = torch.stack([p.covariance[:, 2], -p.covariance[:, 1], p.covariance[:, 0]], -1) / p.determinant[:, None]
    least = 0.9 * c.ALPHA_MIN if skips else 1e-7
    with torch.no_grad():
        reach = (2 * torch.log(opacities.clamp_min(least) / least))[:, None].sqrt() * p.covariance[:, [0, 2]].sqrt()
        reach = torch.where((p.depths > 0.01)[:, None], reach + 1, torch.zeros_like(reach))
        ids, start = pairs.tile_lists(p.means2d, reach, ranks, size)
        splat, pixel = pairs.candidates(p.means2d, conics, opacities, ids, start, size, least)
    alpha = pairs.alphas(p.means2d, conics, opacities, splat, pixel, size)
    margin = torch.full((size * size,), torch.inf, dtype=torch.float64)
    if skips:
        raw = alpha.detach()
        hit = raw >= c.ALPHA_MIN
        before = pairs.transmittances(torch.where(hit, raw, 0.0), pixel)
        after = before * (1 - torch.where(hit, raw, 0.0))
        keep = hit & (after > c.T_MIN)
        near = torch.where(hit, (after / c.T_MIN - 1).abs(), torch.inf)
        near = torch.minimum(near, torch.minimum((raw / c.ALPHA_MIN - 1).abs(), (raw / c.ALPHA_MAX - 1).abs()))
        reached = before > c.T_MIN
        margin.scatter_reduce_(0, pixel[reached], near[reached], "amin")
        splat, pixel, alpha = splat[keep], pixel[keep], alpha[keep]
    weight = alpha * pairs.transmittances(alpha, pixel)
    image = torch.zeros(size * size, colors.shape[1], dtype=torch.float64)
    image = image.index_add(0, pixel, weight[:, None] * colors[splat])
    covered = torch.zeros(size * size, dtype=torch.float64).index_add(0, pixel, weight)
    return Exact(image.view(size, size, -1), covered.view(size, size), margin.view(size, size))
