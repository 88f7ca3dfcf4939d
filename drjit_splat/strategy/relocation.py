"""Opacities and scales of Gaussians that several others join."""

from __future__ import annotations

import math

import torch
from torch import Tensor

N_MAX = 51  # most Gaussians that share one place


def binomials(n_max: int = N_MAX) -> Tensor:
    """Binomial coefficients [n_max, n_max] (float64): row n, column k is n over k."""
    return torch.tensor([[math.comb(n, k) for k in range(n_max)] for n in range(n_max)], dtype=torch.float64)


def compute_relocation(
    opacities: Tensor,  # [N]
    scales: Tensor,  # [N, 3]
    ratios: Tensor,  # [N] integers
    binoms: Tensor,  # [n_max, n_max]
    min_opacity: float = 0.005,
) -> tuple[Tensor, Tensor]:
    """Opacity and scale with which `ratios` equal Gaussians look like one (Kheradmand et al. 2024, eq. 9).

    Args:
        opacities: [N] in (0, 1], before.
        scales: [N, 3], before.
        ratios: [N] how many share a place, counted up to n_max.
        binoms: what `binomials` gives.
        min_opacity: least opacity that comes out.

    Returns:
        Opacities [N] and scales [N, 3], of the types that came in.
    """
    n_max = len(binoms)
    count = ratios.clamp(1, n_max)
    before = opacities.double()
    after = 1 - (1 - before) ** (1 / count)
    after = after.clamp(min_opacity, 1 - torch.finfo(torch.float32).eps)
    # The sum over i = 1 ... count and k < i of binom(i - 1, k) (-1)^k / sqrt(k + 1) after^(k + 1). The terms alternate
    # and reach 1e14 times the sum: float64 keeps nine digits of it where float32 has none.
    k = torch.arange(n_max, device=opacities.device)
    weights = binoms.double().to(opacities.device).cumsum(0)[count - 1] * (1 - 2 * (k % 2)) / (k + 1.0).sqrt()
    total = (weights * after[:, None] ** (k + 1)).sum(-1)
    return after.to(opacities.dtype), (scales.double() * (before / total)[:, None]).to(scales.dtype)
