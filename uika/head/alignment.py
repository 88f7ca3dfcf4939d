"""Rigid motions with a scale between two states of a mesh."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import Camera


def align(points: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scale [], rotation [3,3] and shift [3] (float64) that bring `points` [N,3] nearest to `target` [N,3] (Umeyama).

    `weight` [N] says how much each point counts.
    """
    share = (weight / weight.sum())[:, None].double()
    first, second = points.double(), target.double()
    centre, aim = (share * first).sum(0), (share * second).sum(0)
    u, s, vt = torch.linalg.svd(((second - aim) * share).mT @ (first - centre))
    flip = torch.ones(3, dtype=s.dtype)
    flip[2] = torch.sign(torch.linalg.det(u @ vt))
    rotation = (u * flip) @ vt
    scale = (s * flip).sum() / (share * (first - centre).square()).sum()
    return scale, rotation, aim - scale * rotation @ centre


def aligned_camera(points: Tensor, target: Tensor, weight: Tensor, camera: Camera) -> Camera:
    """The camera that sees `points` [N,3] as `camera` sees `target` [N,3], as well as a rigid motion and a scale can.

    The fit cannot tell size from distance; pictures do not either, so that the camera takes up the difference.
    """
    scale, rotation, shift = align(points, target, weight)
    viewmat = camera.viewmat.double().clone()
    outer = viewmat[:3, :3]
    viewmat[:3, 3] = (outer @ shift + viewmat[:3, 3]) / scale
    viewmat[:3, :3] = outer @ rotation
    return Camera(viewmat.float(), camera.K, camera.width, camera.height)
