"""The avatar's mesh as other programs take it: one vertex for each corner of the atlas, skin and morph targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.export.texture import uv_tiles
from uika.head import HeadModel, HeadParameters, rest_joints, vertex_normals
from uika.head.seams import cut_seams

_INFLUENCES = 4  # joints a vertex, the most that glTF's first set holds


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """N vertices in the neutral, unposed face of one person; metres, Y up."""

    vertex: Tensor  # [N] the head's vertex that each one is
    uvs: NDArray[np.float32]  # [N,2] in [0,1], v down, from the left side of the tile
    faces: dict[int, NDArray[np.uint32]]  # UV tile -> triangles [F,3]
    positions: NDArray[np.float32]  # [N,3]
    normals: NDArray[np.float32]  # [N,3] unit
    joints: NDArray[np.float32]  # [5,3] in the order of `JOINT_NAMES`
    joint_ids: NDArray[np.uint8]  # [N,4]
    weights: NDArray[np.float32]  # [N,4], rows sum to one
    morphs: dict[str, NDArray[np.float32]]  # name -> displacement [N,3] at full activation


def skinned_mesh(avatar: Avatar, head: HeadModel) -> SkinnedMesh:
    """The mesh that carries an avatar's Gaussians.

    Pose correctives, which FLAME heads have, have no place in a skinned mesh and are left out.

    Raises:
        AvatarError: the head model is another one.
    """
    avatar.check_head(head)
    tiles = uv_tiles(head)
    found, triangles = cut_seams(head, tiles)
    vertex, uv, tile = found.unbind(-1)
    canonical = avatar.canonical_vertices(head)
    uvs = torch.stack((head.uvs[uv, 0] - tile, 1 - head.uvs[uv, 1]), -1)
    strength, joint_ids = head.lbs_weights[vertex].topk(_INFLUENCES, dim=-1)
    strength = strength / strength.sum(-1, keepdim=True)
    joint_ids = torch.where(strength > 0, joint_ids, 0)  # unused places name the first joint, as glTF asks
    still = HeadParameters.zeros(head).replace(identity=avatar.identity)
    return SkinnedMesh(
        vertex=vertex,
        uvs=uvs.float().numpy(),
        faces={int(t): triangles[tiles == t].numpy().astype(np.uint32) for t in tiles.unique()},
        positions=canonical[vertex].float().numpy(),
        normals=_unit(vertex_normals(canonical, head.faces)[vertex]),
        joints=rest_joints(head, still).float().numpy(),
        joint_ids=joint_ids.byte().numpy(),
        weights=strength.float().numpy(),
        morphs={
            name: head.expression_basis[index][vertex].float().numpy()
            for index, name in enumerate(head.expression_names)
        },
    )


def _unit(normals: Tensor) -> NDArray[np.float32]:
    """Unit normals; up where a vertex has none."""
    up = torch.tensor([0.0, 1.0, 0.0])
    return torch.where(normals.norm(dim=-1, keepdim=True) > 0.5, normals, up).float().numpy()
