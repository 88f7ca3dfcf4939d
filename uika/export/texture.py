"""Textures from an avatar's Gaussians: their colours laid out in the head's atlas."""

from __future__ import annotations

import io
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from uika.avatar import Avatar
from uika.head import HeadModel

SIZE = 1024  # texels, of a texture's side
_GRID = (64, 2048)  # least and largest side of the map that the Gaussians are laid out in


def uv_tiles(head: HeadModel) -> Tensor:
    """Number of the UV tile [F] that each triangle lies in: tile n holds u in [n, n + 1]."""
    return head.uvs[head.uv_faces][..., 0].mean(1).floor().long()


def bake_texture(avatar: Avatar, head: HeadModel, tile: int = 0, size: int = SIZE) -> NDArray[np.uint8]:
    """The avatar's colours as a texture [size,size,3] of sRGB bytes, first row at v = 1.

    Each Gaussian's colour, weighted by its opacity, is shared among the four nearest texels of a map with about one
    Gaussian a texel; what none reached, gaps and the surroundings of the atlas, is filled from coarser and coarser
    maps (push-pull; Gortler et al., 1996), so that filtering at seams finds no foreign colour.

    Args:
        avatar: the avatar.
        head: the head model that it was made for.
        tile: the UV tile.
        size: side in texels.
    """
    here = uv_tiles(head)[avatar.triangle] == tile
    if not bool(here.any()):  # nothing is known of it
        plain = (avatar.colors.mean(0).clamp(0, 1) * 255).round().byte()
        return plain.expand(size, size, 3).contiguous().numpy()
    corners = head.uvs[head.uv_faces[avatar.triangle[here]]]
    uv = (corners * avatar.barycentric[here][..., None]).sum(1)
    place = torch.stack((uv[:, 0] - tile, 1 - uv[:, 1]), -1)
    grid = _grid_side(head, tile, int(here.sum()))
    values = torch.cat((avatar.colors[here], torch.ones(len(place), 1)), -1) * avatar.opacities[here][:, None]
    color = _push_pull(_scattered(place, values, grid))
    picture = interpolate(color, (size, size), mode="bicubic", align_corners=False)[0].clamp(0, 1)
    return (picture.permute(1, 2, 0) * 255).round().byte().numpy()


def _grid_side(head: HeadModel, tile: int, count: int) -> int:
    """Side of the map in which the tile's triangles cover as many texels as there are Gaussians."""
    corners = head.uvs[head.uv_faces[uv_tiles(head) == tile]]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = float((one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]).abs().sum()) / 2
    return min(max(round(math.sqrt(count / max(area, 1e-6))), _GRID[0]), _GRID[1])


def _scattered(place: Tensor, values: Tensor, side: int) -> Tensor:
    """Sums [1,4,side,side] of values [N,4] at places [N,2] in [0,1], v down, shared bilinearly."""
    at = place * side - 0.5
    low = at.floor().long()
    share = at - low
    canvas = torch.zeros(side * side, 4)
    for dx in (0, 1):
        for dy in (0, 1):
            weight = (share[:, 0] if dx else 1 - share[:, 0]) * (share[:, 1] if dy else 1 - share[:, 1])
            cell = (low + torch.tensor([dx, dy])).clamp(0, side - 1)
            canvas.index_add_(0, cell[:, 1] * side + cell[:, 0], values * weight[:, None])
    return canvas.T.view(1, 4, side, side)


def _push_pull(sums: Tensor) -> Tensor:
    """Colours [1,3,S,S] everywhere from weighted sums [1,4,S,S]."""
    side = sums.shape[-1]
    if side == 1:
        return sums[:, :3] / sums[:, 3:].clamp_min(1e-8)
    coarser = interpolate(sums, ((side + 1) // 2,) * 2, mode="area")
    weight = coarser[:, 3:].clamp_min(1e-8)
    below = interpolate(_push_pull(coarser / weight.clamp_min(1)), (side, side), mode="bilinear", align_corners=False)
    known = (sums[:, 3:] * 4).clamp_max(1)  # a quarter of a full weight is enough to trust a texel
    return known * sums[:, :3] / sums[:, 3:].clamp_min(1e-8) + (1 - known) * below


def as_png(picture: NDArray[np.uint8]) -> bytes:
    """A picture [H,W,3] as a PNG file."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", optimize=True)
    return file.getvalue()
