"""Points of the head's surface whose places in photos are known, beside the landmarks of a detector."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from uika.head import HeadModel


@dataclass(frozen=True)
class SurfaceMarks:
    """Where N photos show D points.

    triangle [D] and barycentric [D,3] of the points; place [N,D,2] crop pixels; weight [N,D] trust in [0,1], 0 where a
    photo does not show the point.
    """

    triangle: Tensor
    barycentric: Tensor
    place: Tensor
    weight: Tensor

    def on(self, head: HeadModel, vertices: Tensor) -> Tensor:
        """The points [...,D,3] on a head with vertices [...,V,3]."""
        return (vertices[..., head.faces[self.triangle], :] * self.barycentric[..., None].to(vertices.dtype)).sum(-2)
