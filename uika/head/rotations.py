"""Rotations as axis-angle vectors, matrices and quaternions (wxyz), in torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def rodrigues(axis_angle: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] of axis-angle vectors [...,3] in radians; smooth at zero."""
    # The floor keeps the square root's gradient finite at zero; sinc keeps both factors exact there.
    angle = (axis_angle.square().sum(-1) + 1e-30).sqrt()[..., None, None]
    first = torch.sinc(angle / math.pi)
    second = 0.5 * torch.sinc(angle / (2 * math.pi)).square()
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + first * cross + second * (cross @ cross)


def multiply_quaternions(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton product of wxyz quaternions [...,4]: rotate by `second`, then by `first`."""
    w1, x1, y1, z1 = first.unbind(-1)
    w2, x2, y2, z2 = second.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )


def quaternions_to_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] of wxyz quaternions [...,4] of any length but 0."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def quaternion_components(matrix: Tensor) -> Tensor:
    """Quaternions [4,...] (wxyz, any sign, any length but 0) of rotations [3,3,...]; components first for speed."""
    xx, yy, zz = matrix[0, 0], matrix[1, 1], matrix[2, 2]
    x, y, z = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    xy, xz, yz = matrix[0, 1] + matrix[1, 0], matrix[0, 2] + matrix[2, 0], matrix[1, 2] + matrix[2, 1]
    squares = torch.stack((1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz))
    rows = (
        torch.stack((squares[0], x, y, z)),
        torch.stack((x, squares[1], xy, xz)),
        torch.stack((y, xy, squares[2], yz)),
        torch.stack((z, xz, yz, squares[3])),
    )
    # Each row is the quaternion times four times one of its entries; the largest entry gives the exactest row.
    best = squares.argmax(0)
    chosen = rows[3]
    for index in range(3):
        chosen = torch.where(best == index, rows[index], chosen)
    return chosen


def matrices_to_quaternions(rotation: Tensor) -> Tensor:
    """Unit quaternions [...,4] (wxyz) of rotation matrices [...,3,3]."""
    chosen = quaternion_components(rotation.movedim((-2, -1), (0, 1))).movedim(0, -1)
    return torch.nn.functional.normalize(chosen, dim=-1)
