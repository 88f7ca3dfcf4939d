"""A head's closed surface, its bust included, as splats."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import Camera, HeadModel, HeadParameters, pose_gaussians, pose_vertices, uv_texels

TEXELS = 512


def texture(size: int = 512) -> Tensor:
    """A colourful smooth sRGB map [3,S,S] with some detail."""
    v, u = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    waves = [0.5 + 0.35 * torch.sin(2 * torch.pi * (a * u + b * v)) for a, b in ((5, 1), (2, -4), (-3, 6))]
    return torch.stack(waves)


def splat_head(
    head: HeadModel, params: HeadParameters, channels: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Splat a head's closed surface, with its bust where it has one.

    Args:
        head: the head model.
        params: one frame.
        channels: [D,S,S] UV map of what to splat; a bust's tile repeats it.
        camera: one camera.

    Returns:
        The channels [H,W,D] divided by the coverage, the coverage [H,W] and the expected depth [H,W].
    """
    from drjit_splat import rasterization
    from uika.canonical.surface import closing_splats

    rest = pose_vertices(head, HeadParameters.zeros(head).replace(identity=params.identity))
    tiles = [uv_texels(head, TEXELS, tile=tile) for tile in range(1 if head.bust is None else 2)]
    still = rest.detach()
    parts = [closing_splats(head, still, binding) for binding in tiles]
    points, rotations, sizes = (torch.cat(part) for part in zip(*parts, strict=True))
    means, quats, scales = pose_gaussians(
        points,
        rotations,
        sizes,
        rest,
        pose_vertices(head, params),
        head.faces,
        torch.cat([binding.triangle for binding in tiles]),
        torch.cat([binding.barycentric for binding in tiles]),
    )
    values = torch.nn.functional.interpolate(channels[None], (TEXELS, TEXELS), mode="bilinear", antialias=True)[0]
    image, alpha, _ = rasterization(
        means,
        quats,
        scales,
        torch.full((len(means),), 0.95),
        torch.cat([binding.from_map(values) for binding in tiles]),
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        render_mode="RGB+ED",
    )
    coverage = alpha[0, ..., 0]
    return image[0, ..., :-1] / coverage.clamp_min(1e-6)[..., None], coverage, image[0, ..., -1]
