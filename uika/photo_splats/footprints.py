"""Splats that lie along a photo's depths: seen from the side they close instead of standing apart as a comb."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head.rotations import matrices_to_quaternions
from uika.photo_splats.layers import PhotoView

STEEPEST = 6.0  # depth over width of a pixel's piece of surface: steeper ones are seen as an edge
THICK = 0.5  # of a splat, over its width across the view


def footprints(
    view: PhotoView, depth: Tensor, kind: Tensor, row: Tensor, column: Tensor, spread: float
) -> tuple[Tensor, Tensor]:
    """Rotations [M,4] (wxyz) and standard deviations [M,3] in metres of splats at pixels of a photo.

    In the photo each is round; along the view it is as long as its piece of the surface.

    Args:
        view: the photo, S pixels on each side.
        depth: [S,S] metres.
        kind: [S,S] labels; depths of different ones do not belong together.
        row: [M] of the pixels.
        column: [M]
        spread: standard deviation in the photo, pixels.
    """
    K, rotation = view.camera.K, view.camera.viewmat[:3, :3]
    at = depth[row, column]
    unit = at / K[0, 0]
    ray = torch.stack(((column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], torch.ones_like(at)), -1)
    across, down = (
        _slopes(depth, kind, axis)[row, column].clamp(-STEEPEST * unit, STEEPEST * unit)[:, None] * ray
        for axis in (1, 0)
    )
    across[:, 0] += unit
    down[:, 1] += unit
    # Principal axes of the ellipse that the two span, as in a Jacobi rotation.
    angle = 0.5 * torch.atan2(2 * (across * down).sum(-1), (across**2 - down**2).sum(-1))[:, None]
    first = torch.cos(angle) * across + torch.sin(angle) * down
    second = torch.cos(angle) * down - torch.sin(angle) * across
    long, short = first.norm(dim=-1), second.norm(dim=-1)
    one, other = first / long[:, None], second / short[:, None]
    axes = torch.stack((one, other, torch.linalg.cross(one, other)), -1)
    scales = spread * torch.stack((long, short, THICK * unit), -1)
    return matrices_to_quaternions(rotation.mT @ axes), scales


def _slopes(depth: Tensor, kind: Tensor, axis: int) -> Tensor:
    """Change of depths [S,S] from pixel to pixel: the smaller of both sides, 0 at a crest and where none belongs."""
    step = depth.diff(dim=axis)
    step = torch.where(kind.diff(dim=axis) == 0, step, torch.nan)
    edge = torch.full_like(depth.narrow(axis, 0, 1), torch.nan)
    before, after = torch.cat((edge, step), axis), torch.cat((step, edge), axis)
    before, after = (torch.where(a.isnan(), b, a) for a, b in ((before, after), (after, before)))
    smaller = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(before * after > 0, smaller, 0.0).nan_to_num()
