"""A head's closed surface as splats."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import Camera, HeadModel, HeadParameters, pose_gaussians, pose_vertices

TEXELS = 512


def texture(size: int = 512) -> Tensor:
    """A colourful smooth sRGB map [3,S,S] with some detail."""
    v, u = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    waves = [0.5 + 0.35 * torch.sin(2 * torch.pi * (a * u + b * v)) for a, b in ((5, 1), (2, -4), (-3, 6))]
    return torch.stack(waves)


def splat_head(
    head: HeadModel, params: HeadParameters, channels: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Splat a head's closed surface.

    Args:
        head: the head model.
        params: one frame.
        channels: [D,S,S] UV map of what to splat.
        camera: one camera.

    Returns:
        The channels [H,W,D] divided by the coverage, the coverage [H,W] and the expected depth [H,W].
    """
    from drjit_splat import rasterization
    from uika.canonical.surface import surface_texels

    surface, binding = surface_texels(head, params.identity.detach(), torch.zeros_like(head.template), TEXELS)
    rest = HeadParameters.zeros(head).replace(identity=params.identity)
    means, quats, scales = pose_gaussians(
        surface.points[0],
        surface.quats[0],
        surface.scales[0],
        pose_vertices(head, rest),
        pose_vertices(head, params),
        head.faces,
        binding.triangle,
        binding.barycentric,
    )
    values = torch.nn.functional.interpolate(channels[None], (TEXELS, TEXELS), mode="bilinear", antialias=True)[0]
    image, alpha, _ = rasterization(
        means,
        quats,
        scales,
        torch.full((len(means),), 0.95),
        binding.from_map(values).contiguous(),
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        render_mode="RGB+ED",
    )
    coverage = alpha[0, ..., 0]
    return image[0, ..., :-1] / coverage.clamp_min(1e-6)[..., None], coverage, image[0, ..., -1]
