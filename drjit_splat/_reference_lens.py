"""The oracle's cameras. Without a pinhole only the mapping is written down, and autograd makes its Jacobian."""

from __future__ import annotations

import torch
from torch import Tensor

from . import constants as c
from ._settings import Settings


def _fisheye(points: Tensor, K: Tensor, radial: Tensor | None) -> Tensor:
    """Pixels [N, 2] of points [N, 3] in front of an equidistant lens with OpenCV's polynomial."""
    x, y, z = points.unbind(-1)
    squared = (x * x + y * y) / (z * z)
    axial = squared < 1e-8
    tangent = torch.where(axial, torch.ones_like(squared), squared).sqrt()
    ratio = torch.where(axial, 1 - squared / 3 + squared * squared / 5, torch.atan(tangent) / tangent)
    theta = squared * ratio * ratio  # the angle's square
    if radial is not None:
        ratio = ratio * (1 + sum(radial[k] * theta ** (k + 1) for k in range(4)))
    return torch.stack([K[0, 0] * x / z * ratio + K[0, 2], K[1, 1] * y / z * ratio + K[1, 2]], -1)


def _ortho(points: Tensor, K: Tensor, radial: Tensor | None) -> Tensor:
    return torch.stack([K[0, 0] * points[:, 0] + K[0, 2], K[1, 1] * points[:, 1] + K[1, 2]], -1)


def _pinhole(points: Tensor, K: Tensor, settings: Settings) -> tuple[Tensor, Tensor]:
    """Pixels [N, 2] of points [N, 3] in camera space, and the Jacobian [N, 2, 3] with its slopes clamped."""
    s = settings
    z = points[:, 2]
    slopes = points[:, :2] / z[:, None]
    rows = []
    for i, size in enumerate((s.width, s.height)):
        focal, centre = K[i, i], K[i, 2]
        margin = c.FRUSTUM_MARGIN * 0.5 * size / focal
        low, high = -centre / focal - margin, (size - centre) / focal + margin
        if s.inria:  # symmetric about the optical axis, wherever the image lies
            high = (1 + c.FRUSTUM_MARGIN) * 0.5 * size / focal
            low = -high
        clamped = torch.minimum(torch.maximum(slopes[:, i], low), high)
        row = [torch.zeros_like(z)] * 2 + [-focal * clamped / z]
        row[i] = focal / z
        rows.append(torch.stack(row, -1))
    return slopes * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2], torch.stack(rows, 1)


def within_lens(points: Tensor, settings: Settings, radial: Tensor | None) -> Tensor:
    """Whether the image radius of the points [N, 3] still grows with their angle from the axis."""
    if settings.camera_model != "fisheye" or radial is None:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    theta = torch.atan2(points[:, :2].norm(dim=-1), points[:, 2]).detach()
    growth: Tensor = 1 + sum((2 * k + 3) * radial[k] * theta ** (2 * k + 2) for k in range(4))  # type: ignore[assignment]
    return growth > 0


def see(points: Tensor, K: Tensor, settings: Settings, radial: Tensor | None) -> tuple[Tensor, Tensor]:
    """Pixels [N, 2] of points [N, 3] in camera space, and the mapping's Jacobian [N, 2, 3] there."""
    if settings.camera_model == "pinhole":
        return _pinhole(points, K, settings)
    mapping = _fisheye if settings.camera_model == "fisheye" else _ortho
    with torch.enable_grad():
        start = points if points.requires_grad else points.detach().requires_grad_()
        pixels = mapping(start, K, radial)
        rows = [torch.autograd.grad(pixels[:, i].sum(), start, create_graph=True)[0] for i in range(2)]
    return pixels, torch.stack(rows, 1)
