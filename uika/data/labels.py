"""Exact correspondence of captured pictures, from the heads that were tracked in them."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.data import DataError
from uika.data.views import View
from uika.head import HeadModel, HeadParameters, pose_vertices, project, rasterize

_PERSON = 0.5  # mask


def check_parameters(view: View, head: HeadModel) -> HeadParameters:
    """The view's parameters, if they are those of this head model.

    Raises:
        DataError: it has none, or another model's; the message names the image and what to do.
    """
    if view.parameters is None:
        raise DataError(
            f"{view.key}: has no head parameters; track the capture first (VHAP writes flame_param_path into it)"
        )
    head = head.without_bust
    sizes = (len(head.identity_basis), len(head.expression_basis), len(head.template))
    offset = len(head.template) if view.static_offset is None else len(view.static_offset)
    found = (len(view.parameters.identity), len(view.parameters.expression), offset)
    if found != sizes:
        raise DataError(
            f"{view.key}: has {found[0]} identities, {found[1]} expressions and {found[2]:,} vertices, but the head "
            f"model '{head.id}' has {sizes[0]}, {sizes[1]} and {sizes[2]:,}; give the capture's own with --head"
        )
    return view.parameters


def tracked_uv(view: View, head: HeadModel) -> Tensor:
    """UV coordinates [2,S,S] (v down) that the pixels of a view show, NaN where they show no part of the tracked head.

    Raises:
        DataError: as `check_parameters`.
    """
    vertices = pose_vertices(head, check_parameters(view, head), view.static_offset)
    camera = view.camera
    points, depth = project(vertices, camera)
    triangle, mix = rasterize(points, head.faces, camera.height, camera.width, depth=depth, cull="back")
    corner_uv = head.uvs[head.uv_faces] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    place = (corner_uv[triangle.clamp(min=0)] * mix[..., None]).sum(-2).clamp(0, 1)
    shown = (triangle >= 0) & (view.mask > _PERSON)
    return torch.where(shown[..., None], place, torch.nan).permute(2, 0, 1)
