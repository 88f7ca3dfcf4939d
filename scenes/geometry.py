"""The head mesh as Mitsuba needs it: one vertex for each distinct pair of position and texture coordinate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from uika.head import HeadModel, vertex_normals
from uika.head.seams import cut_seams

_MIN_FACING = 0.05


@dataclass(frozen=True, eq=False)
class SeamMesh:
    """A mesh of N vertices whose UV seams are cut open; triangle order is the head's."""

    source: np.ndarray  # [N] vertex of the head that each one copies
    texcoords: np.ndarray  # [N,2] float32 in [0,1], v down
    faces: np.ndarray  # [F,3] uint32

    def positions(self, vertices: torch.Tensor) -> np.ndarray:
        """Positions [N,3] of head vertices [V,3]."""
        return vertices.numpy()[self.source]

    def normals(self, vertices: torch.Tensor, faces: torch.Tensor, eye: torch.Tensor) -> np.ndarray:
        """Unit normals [N,3], smooth across the seams, of a head [V,3] seen from `eye` [3].

        Normals that face away are bent until they just face the eye: on outline triangles the interpolated normal
        would otherwise point behind the surface and shade black.
        """
        normals = vertex_normals(vertices, faces)
        view = torch.nn.functional.normalize(eye - vertices, dim=-1)
        facing = (normals * view).sum(-1, keepdim=True)
        bent = torch.nn.functional.normalize(normals + (_MIN_FACING - facing).clamp_min(0) * view, dim=-1)
        return bent.numpy()[self.source]


def seam_mesh(head: HeadModel) -> SeamMesh:
    """The head's mesh with its UV seams cut open."""
    distinct, triangles = cut_seams(head)
    u, v = head.uvs.numpy()[distinct[:, 1]].T
    return SeamMesh(distinct[:, 0].numpy(), np.stack((u, 1 - v), -1), triangles.numpy().astype(np.uint32))
