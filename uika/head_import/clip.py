"""Cutting a textured mesh where a function of its vertices changes sign."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Cut:
    """What is left of a mesh; new corners lie on its edges."""

    one: Ids  # [N] vertices of the mesh
    other: Ids  # [N]
    share: Array  # [N] of the second one
    faces: Ids  # [F,3] into the N
    uvs: Array  # [T,2]
    uv_faces: Ids  # [F,3]

    def of(self, values: NDArray) -> NDArray:
        """Values [...,N,C] of the mesh's [...,V,C]."""
        share = self.share[:, None]
        return (1 - share) * values[..., self.one, :] + share * values[..., self.other, :]


def clip(height: Array, faces: Ids, uvs: Array, uv_faces: Ids) -> Cut:
    """Keep what of a mesh lies where `height` [V] is not negative.

    Args:
        height: linear on every triangle.
        faces: [F,3] vertices.
        uvs: [T,2] texture coordinates.
        uv_faces: [F,3] into them.
    """
    corners: dict[tuple[int, int, float], int] = {}  # (one, other, share of the other)
    textures: dict[tuple[int, int, float], int] = {}
    new_faces, new_uv_faces = [], []
    for face, texture in zip(faces.tolist(), uv_faces.tolist(), strict=True):
        polygon, outline = [], []
        for (a, s), (b, t) in zip(
            zip(face, texture, strict=True),
            zip(face[1:] + face[:1], texture[1:] + texture[:1], strict=True),
            strict=True,
        ):
            if height[a] >= 0:
                polygon.append(corners.setdefault((a, a, 0.0), len(corners)))
                outline.append(textures.setdefault((s, s, 0.0), len(textures)))
            if (height[a] >= 0) != (height[b] >= 0):
                # Both triangles of an edge must find the same point: count from the same end.
                (a, s), (b, t) = sorted(((a, s), (b, t)))
                share = float(height[a] / (height[a] - height[b]))
                polygon.append(corners.setdefault((a, b, share), len(corners)))
                outline.append(textures.setdefault((s, t, share), len(textures)))
        for k in range(1, len(polygon) - 1):
            new_faces.append([polygon[0], polygon[k], polygon[k + 1]])
            new_uv_faces.append([outline[0], outline[k], outline[k + 1]])
    first_ends, second_ends, shares = (np.array(column) for column in zip(*corners, strict=True))
    first, second, mix = (np.array(column) for column in zip(*textures, strict=True))
    places = (1 - mix[:, None]) * uvs[first] + mix[:, None] * uvs[second]
    return Cut(first_ends, second_ends, shares, np.array(new_faces), places, np.array(new_uv_faces))
