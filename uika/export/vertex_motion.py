"""How the Gaussians on each vertex of an avatar's mesh move."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.head import HeadModel, pose_gaussians, pose_vertices
from uika.motion import Motion

_CHUNK = 64  # frames posed at once


def vertex_motion(avatar: Avatar, motion: Motion, head: HeadModel) -> Tensor:
    """[T,V,8] x y z (metres), growth, w x y z: how Gaussians that sit on the vertices move."""
    rest = avatar.canonical_vertices(head)
    count = len(rest)
    triangle, barycentric = torch.zeros(count, dtype=torch.int64), torch.zeros(count, 3)
    for corner in range(3):
        ids = head.faces[:, corner]
        triangle[ids] = torch.arange(len(ids))
        barycentric[ids] = torch.eye(3)[corner]
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    params = motion.parameters(avatar.identity)
    parts = []
    for start in range(0, len(motion), _CHUNK):
        posed = pose_vertices(head, params[start : start + _CHUNK], avatar.static_offset)
        _, quats, scales = pose_gaussians(
            rest, identity, torch.ones(count, 3), rest, posed, head.faces, triangle, barycentric
        )
        quats = torch.where(quats[..., :1] < 0, -quats, quats)
        parts.append(torch.cat((posed, scales[..., :1], quats), -1))
    return torch.cat(parts)
