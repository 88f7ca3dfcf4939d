"""The bust as a membrane: its own B vertices, held where it hangs on the head's rim."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from uika.head import HeadModel, vertex_normals

Array = NDArray[np.float64]

BENDING, TENSION = 10.0, 0.05  # smoothness of a displacement against what pulls it
BACK_PULL = 1e-2  # towards no displacement
NORMAL_ROUNDS = 20  # of averaging


class BustMesh:
    """U vertices of a head's bust, the B of its own before those of the rim, with their edges and smoothness."""

    def __init__(self, head: HeadModel) -> None:
        """Prepare.

        Raises:
            ValueError: the head has no bust.
        """
        if head.bust is None:
            raise ValueError(f"the head model '{head.id}' has no bust")
        from scipy import sparse

        self.head, self.modes = head, head.bust.modes.double().numpy()
        self.first = head.bust.vertex
        triangles = head.faces[head.bust.face :]
        touched = triangles.unique()
        self.count = len(head.template) - self.first
        self.rim = touched[touched < self.first]
        self.used = torch.cat((torch.arange(self.first, len(head.template)), self.rim))
        place = torch.full((len(head.template),), -1)
        place[self.used] = torch.arange(len(self.used))
        corners = place[triangles]
        pairs = torch.cat((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]))
        self.edges: NDArray[np.int64] = pairs.sort(1).values.unique(dim=0).numpy()
        both = np.concatenate((self.edges, self.edges[:, ::-1]))
        both = both[both[:, 0] < self.count]
        points = head.template[self.used].double().numpy()
        weight = 1.0 / np.linalg.norm(points[both[:, 0]] - points[both[:, 1]], axis=1).clip(1e-4)
        degree = np.bincount(both[:, 0], weight, self.count)
        adjacency = sparse.csr_matrix((weight, tuple(both.T)), shape=(self.count, len(self.used)))
        laplacian: Any = sparse.eye(self.count, len(self.used)) - sparse.diags(1.0 / degree) @ adjacency
        laplacian = laplacian.tocsr()
        inner, outer = laplacian[:, : self.count], laplacian[:, self.count :]
        self._energy: Any = BENDING * inner.T @ inner + 0.5 * TENSION * (inner + inner.T)
        self._held: Any = BENDING * inner.T @ outer + TENSION * outer

    def continued(self, static_offset: Tensor) -> Tensor:
        """An offset [H,3] of the head alone as one [V,3] of the whole, dying away on the bust."""
        given = static_offset[self.rim].double().numpy()
        solved = self._solve(np.zeros(self.count), -self._held @ given)
        return torch.cat((static_offset[: self.first], torch.from_numpy(solved).to(static_offset.dtype)))

    def shaped(self, offset: Tensor, shape: Array) -> Tensor:
        """The offset [V,3] with the bust's modes added, coefficients [J]."""
        return self._added(offset, np.tensordot(shape, self.modes, 1))

    def lifted(self, offset: Tensor, height: Array, normals: Tensor) -> Tensor:
        """The offset [V,3] with the bust lifted by heights [B] along normals [B,3]."""
        return self._added(offset, height[:, None] * normals.double().numpy())

    def smooth_normals(self, vertices: Tensor) -> Tensor:
        """Normals [B,3] of the bust of a mesh [V,3], averaged over their neighbourhood."""
        normals = vertex_normals(vertices, self.head.faces)[self.used]
        start, end = torch.from_numpy(self.edges).T
        for _ in range(NORMAL_ROUNDS):
            total = normals.index_add(0, start, normals[end]).index_add(0, end, normals[start])
            normals = normalize(total, dim=-1)
        return normals[: self.count]

    def membrane(self, target: Array, pull: Array) -> Array:
        """Smooth heights [B], zero at the rim, that reach for targets [B] with strengths [B]."""
        return self._solve(pull, pull * target)

    def _solve(self, pull: Array, right: Array) -> Array:
        from scipy import sparse
        from scipy.sparse.linalg import splu

        return splu((self._energy + sparse.diags(pull + BACK_PULL)).tocsc()).solve(right)

    def _added(self, offset: Tensor, own: Array) -> Tensor:
        return torch.cat((offset[: self.first], offset[self.first :] + torch.from_numpy(own).to(offset.dtype)))
