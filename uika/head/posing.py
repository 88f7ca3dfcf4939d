"""Shape, joints and linear-blend skinning of the parametric head (paper section 3.3; FLAME conventions)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uika.head.model import JOINT_PARENTS, HeadModel
from uika.head.parameters import HeadParameters
from uika.head.rotations import rodrigues


def shaped_vertices(head: HeadModel, params: HeadParameters, static_offset: Tensor | None = None) -> Tensor:
    """Vertices [...,V,3] in metres with identity, `static_offset` [V,3] and expression, before any pose.

    An offset of the head alone leaves the bust where it is.

    Raises:
        ValueError: the number of identity or expression coefficients is not the head's.
    """
    neutral = head.template
    if static_offset is not None:
        if head.bust is not None and len(static_offset) == head.bust.vertex:
            static_offset = torch.nn.functional.pad(static_offset, (0, 0, 0, len(head.template) - head.bust.vertex))
        neutral = neutral + static_offset
    identity = _blend(params.identity, head.identity_basis, "identity")
    return neutral + identity + _blend(params.expression, head.expression_basis, "expression")


def rest_joints(head: HeadModel, params: HeadParameters) -> Tensor:
    """Joints [...,5,3] in metres of the shaped head before any pose."""
    identity = _blend(params.identity, head.joint_identity, "identity")
    return head.joints + identity + _blend(params.expression, head.joint_expression, "expression")


def joint_transforms(head: HeadModel, params: HeadParameters) -> Tensor:
    """Transforms [...,5,4,4] from the rest pose to the posed head, the translation included."""
    return _transforms(rest_joints(head, params), _joint_rotations(params), params.translation)


def pose_vertices(head: HeadModel, params: HeadParameters, static_offset: Tensor | None = None) -> Tensor:
    """Posed vertices [...,V,3] in metres by linear-blend skinning, with pose correctives where the head has them."""
    rotations = _joint_rotations(params)
    vertices = shaped_vertices(head, params, static_offset)
    if head.pose_basis is not None:
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        features = (rotations[..., 1:, :, :] - identity).flatten(-3)
        vertices = vertices + _blend(features, head.pose_basis, "pose")
    transforms = _transforms(rest_joints(head, params), rotations, params.translation)
    blended = (head.lbs_weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] * vertices[..., None, :]).sum(-1) + blended[..., 3]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit vertex normals [...,V,3] of a mesh [...,V,3] with triangles [F,3]; zero where undefined."""
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    weighted = torch.linalg.cross(b - a, c - a)
    corners = weighted.repeat_interleave(3, dim=-2)
    total = torch.zeros_like(vertices).index_add(-2, faces.flatten(), corners)
    return torch.nn.functional.normalize(total, dim=-1, eps=1e-20)


def _blend(coefficients: Tensor, basis: Tensor, name: str) -> Tensor:
    if coefficients.shape[-1] != len(basis):
        raise ValueError(f"{name} has {coefficients.shape[-1]} coefficients; this head has {len(basis)}")
    return (coefficients @ basis.flatten(1)).unflatten(-1, basis.shape[1:])


def _joint_rotations(params: HeadParameters) -> Tensor:
    parts = (params.rotation, params.neck, params.jaw, params.eyes[..., :3], params.eyes[..., 3:])
    return rodrigues(torch.stack(torch.broadcast_tensors(*parts), -2))


def _transforms(joints: Tensor, rotations: Tensor, translation: Tensor) -> Tensor:
    batch = np.broadcast_shapes(joints.shape[:-2], rotations.shape[:-3], translation.shape[:-1])
    joints = joints.expand(*batch, -1, -1)
    rotations = rotations.expand(*batch, -1, -1, -1)
    world_rotations: list[Tensor] = []
    world_joints: list[Tensor] = []
    for joint, parent in enumerate(JOINT_PARENTS):
        if parent < 0:
            world_rotations.append(rotations[..., joint, :, :])
            world_joints.append(joints[..., joint, :])
            continue
        offset = joints[..., joint, :] - joints[..., parent, :]
        world_rotations.append(world_rotations[parent] @ rotations[..., joint, :, :])
        world_joints.append((world_rotations[parent] @ offset[..., None])[..., 0] + world_joints[parent])
    rotation = torch.stack(world_rotations, -3)
    shift = torch.stack(world_joints, -2) - (rotation @ joints[..., None])[..., 0] + translation[..., None, :]
    top = torch.cat((rotation, shift[..., None]), -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), -2)
