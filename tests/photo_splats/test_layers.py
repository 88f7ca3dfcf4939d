"""Opacities of splats that overlap."""

import torch

from uika.photo_splats.layers import BLUR, opacities


def composited(opacity: torch.Tensor, spread: float) -> torch.Tensor:
    """Coverage [H,W] at the centres of splats on a grid, by the product over all of them."""
    height, width = opacity.shape
    at = torch.stack(torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"), -1).view(-1, 2).double()
    weight = torch.exp(-0.5 * torch.cdist(at, at) ** 2 / (spread**2 + BLUR))
    return 1 - (1 - weight * opacity.flatten()).prod(1).view(height, width)


def test_overlapping_splats_cover_as_wanted() -> None:
    wanted = torch.zeros(24, 24)
    wanted[4:20, 4:20] = 0.5
    found = composited(opacities(wanted, 0.6, 1), 0.6)
    assert (found[8:16, 8:16] - 0.5).abs().max() < 0.05


def test_a_thin_strand_is_denser_than_one_splat_among_many() -> None:
    wanted = torch.zeros(24, 24)
    wanted[:, 12] = 0.6
    found = opacities(wanted, 0.6, 1)
    assert abs(float(composited(found, 0.6)[12, 12]) - 0.6) < 0.08
    assert bool((found[wanted == 0] == 0).all())
