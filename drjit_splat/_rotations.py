"""Rotation matrices of quaternions, in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from . import constants as c


def quats_to_rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of wxyz quaternions [N, 4] of any length; too short ones give the identity."""
    squared = (quats * quats).sum(-1, keepdim=True)
    short = squared < c.QUAT_MIN_NORM**2
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    unit = torch.where(short, identity, quats / torch.where(short, torch.ones_like(squared), squared).sqrt())
    w, x, y, z = unit.unbind(-1)
    rows = (
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    )
    return torch.stack(rows, -2)
