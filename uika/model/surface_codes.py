"""Places on the mean head as codes without seams, and the way from them to UV coordinates.

Neighbours on the surface have neighbouring codes wherever the atlas is cut, so a network can predict codes that are
smooth across seams, and means of them stay meaningful. A code is the place on the unposed mean head in decimetres and a
fourth coordinate that keeps what lies inside openings (eyeballs, teeth, tongue) apart from lids and lips around it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from uika.head import HeadModel, uv_texels

CODE = 4  # numbers of a code
UNIT = 0.1  # metres of one step of its first three
_INSIDE = 0.2  # fourth coordinate of what lies in an opening
_INNER = ("eyeballs", "mouth_inner")
_CELL_STEP = 0.03  # of the atlas: a point lies at most so far from the texel that its code is nearest to


class SurfaceTable(NamedTuple):
    """T points of the surface."""

    code: Tensor  # [T,4]
    uv: Tensor  # [T,2] v down
    slope: Tensor  # [T,2,4] of uv by code, along the surface


def vertex_codes(head: HeadModel) -> Tensor:
    """Codes [V,4] of the head's vertices."""
    inside = torch.zeros(len(head.template))
    for name in _INNER:
        if name in head.masks:
            inside = torch.maximum(inside, head.masks[name].float())
    return torch.cat((head.template.float() / UNIT, _INSIDE * inside[:, None]), -1)


def surface_table(head: HeadModel, size: int) -> SurfaceTable:
    """One point for each texel of a `size` x `size` atlas that the head covers."""
    head = head.without_bust
    binding = uv_texels(head, size)
    corners = vertex_codes(head)[head.faces]
    code = (corners[binding.triangle] * binding.barycentric[..., None]).sum(1)
    edges = (corners[:, 1:] - corners[:, :1]).double()  # [F,2,4]
    places = _corner_uv(head)
    steps = (places[:, 1:] - places[:, :1]).double()  # [F,2,2]
    slope = steps.mT @ torch.linalg.pinv(edges.mT, rtol=1e-4)
    return SurfaceTable(code, binding.uv, slope[binding.triangle].float())


def codes_at(head: HeadModel, uv: Tensor, size: int = 1024) -> Tensor:
    """Codes [P,4] of places uv [P,2] (v down) in the atlas, exact but for texels of `size` cut by an edge."""
    triangle, mix = bound(head, uv, size)
    return (vertex_codes(head)[head.faces[triangle]] * mix[..., None]).sum(1)


def bound(head: HeadModel, uv: Tensor, size: int = 1024) -> tuple[Tensor, Tensor]:
    """Triangles [P] and barycentrics [P,3] of places uv [P,2] (v down) in the atlas of a head without bust.

    A place in a texel of `size` that an edge cuts may get the triangle beyond; its barycentrics then lie outside [0,1].
    """
    near = _triangle_map(head, size)
    column, row = (uv * size).long().clamp(0, size - 1).unbind(-1)
    triangle = near[row, column]
    a, b, c = _corner_uv(head)[triangle].double().unbind(1)
    base = torch.stack((b - a, c - a), -1)
    flat = torch.linalg.det(base).abs() < 1e-14
    base = torch.where(flat[:, None, None], torch.eye(2, dtype=base.dtype), base)
    share = torch.linalg.solve(base, (uv.double() - a)[..., None])[..., 0]
    mix = torch.cat((1 - share.sum(-1, keepdim=True), share), -1).clamp(-1, 2)
    return triangle, (mix / mix.sum(-1, keepdim=True)).float()


class UvLookup:
    """From codes to UV coordinates: the nearest point of a table and the slope there."""

    def __init__(self, table: SurfaceTable) -> None:
        """Build the search tree."""
        from scipy.spatial import cKDTree

        self._table = SurfaceTable(*(part.double() for part in table))
        self._tree = cKDTree(self._table.code.numpy(), balanced_tree=False, compact_nodes=False)

    def __call__(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """UV [P,2] of codes [P,4], and how far [P] in metres these lie off the surface's points."""
        if len(code) == 0:
            return torch.zeros(0, 2), torch.zeros(0)
        query = code.double()
        distance, index = self._tree.query(query.numpy(), workers=1)
        at = torch.from_numpy(np.asarray(index))
        step = (self._table.slope[at] @ (query - self._table.code[at])[..., None])[..., 0]
        uv = self._table.uv[at] + step.clamp(-_CELL_STEP, _CELL_STEP)
        return uv.clamp(0, 1).float(), torch.from_numpy(distance * UNIT).float()


def _corner_uv(head: HeadModel) -> Tensor:
    """UVs [F,3,2] of the triangles' corners, v down."""
    return head.uvs[head.uv_faces] * head.uvs.new_tensor([1.0, -1.0]) + head.uvs.new_tensor([0.0, 1.0])


@lru_cache(maxsize=2)
def _triangle_map(head: HeadModel, size: int) -> Tensor:
    """The triangle [S,S] of each texel; those outside all charts have the nearest one's."""
    from scipy.ndimage import distance_transform_edt

    binding = uv_texels(head, size)
    filled = torch.full((size * size,), -1)
    filled[binding.texel] = binding.triangle
    filled = filled.view(size, size)
    rows, columns = distance_transform_edt(filled.numpy() < 0, return_distances=False, return_indices=True)
    return filled[torch.from_numpy(rows).long(), torch.from_numpy(columns).long()]
