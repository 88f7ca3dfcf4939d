"""The texels of the head's UV atlas and where on the mesh each of them lies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from uika.head.model import HeadModel
from uika.head.raster import rasterize


@dataclass(frozen=True, eq=False)
class Binding:
    """M points fixed to mesh triangles, one for each covered texel of a square UV map, in row-major order."""

    size: int  # side of the map in texels
    texel: Tensor  # [M] int64, row * size + column
    triangle: Tensor  # [M] int64
    barycentric: Tensor  # [M,3] float32

    def __len__(self) -> int:
        """The number of points."""
        return len(self.texel)

    def to(self, device: torch.device | str) -> Binding:
        """A copy on another device; itself where it already is there."""
        if self.texel.device == torch.device(device):
            return self
        moved = (part.to(device) for part in (self.texel, self.triangle, self.barycentric))
        return Binding(self.size, *moved)

    @property
    def uv(self) -> Tensor:
        """Texel centres [M,2] in [0,1], v down."""
        row = torch.div(self.texel, self.size, rounding_mode="floor")
        return torch.stack((self.texel - row * self.size, row), -1).to(self.barycentric.dtype).add(0.5) / self.size

    @property
    def valid(self) -> Tensor:
        """Boolean map [S,S] of the covered texels."""
        mask = torch.zeros(self.size * self.size, dtype=torch.bool, device=self.texel.device)
        mask[self.texel] = True
        return mask.view(self.size, self.size)

    def to_map(self, values: Tensor, fill: float = 0.0) -> Tensor:
        """Lay point values [...,M,C] out as a map [...,C,S,S], with `fill` where no point lies."""
        lead, channels = values.shape[:-2], values.shape[-1]
        canvas = values.new_full((*lead, channels, self.size * self.size), fill)
        return canvas.index_copy(-1, self.texel, values.mT).unflatten(-1, (self.size, self.size))

    def from_map(self, image: Tensor) -> Tensor:
        """Pick the points' values [...,M,C] from a map [...,C,S,S]."""
        if tuple(image.shape[-2:]) != (self.size, self.size):
            raise ValueError(f"map is {tuple(image.shape[-2:])} texels; this binding needs {self.size}x{self.size}")
        return image.flatten(-2).index_select(-1, self.texel).mT


@lru_cache(maxsize=16)
def uv_texels(
    head: HeadModel, size: int, rule: Literal["watertight", "released"] = "watertight", tile: int = 0
) -> Binding:
    """Find the texels of a `size` x `size` map that one tile of the head's atlas covers; cached for each head.

    Args:
        head: the head model.
        size: side of the map; texel (row, column) has its centre at u = (column+.5)/S, v = (row+.5)/S, v down.
        rule: "watertight" takes every texel centre in the atlas, edges included; "released" takes those strictly
            inside a triangle that runs counter-clockwise with v up, as the authors' released model does, so that
            attribute maps have the same number of Gaussians.
        tile: 0 for the head, 1 for its bust; u is counted from the tile's left side.

    Raises:
        ValueError: the size is not positive or the rule is unknown.
    """
    if size < 1 or rule not in ("watertight", "released"):
        raise ValueError(f"uv_texels needs size >= 1 and rule 'watertight' or 'released', got {size} and {rule!r}")
    points = torch.stack((head.uvs[:, 0] - tile, 1 - head.uvs[:, 1]), -1).double() * size
    if rule == "released":
        triangle, barycentric = rasterize(points, head.uv_faces, size, size, cull="back", rule="strict")
    else:
        triangle, barycentric = rasterize(points, head.uv_faces, size, size, cull="none")
    texel = (triangle.flatten() >= 0).nonzero()[:, 0]
    return Binding(size, texel, triangle.flatten()[texel], barycentric.view(-1, 3)[texel].to(head.template.dtype))
