"""The head's mesh with its UV seams cut open, as renderers and files that know one UV for each vertex need it."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head.model import HeadModel


def cut_seams(head: HeadModel, *labels: Tensor) -> tuple[Tensor, Tensor]:
    """Double the vertices at which triangles differ in texture coordinate or in a label.

    Args:
        head: the head model.
        labels: [F] whole numbers of the triangles.

    Returns:
        For each of N new vertices the old one, its texture coordinate and the labels, [N,2+L] int64 in ascending order;
        and the triangles [F,3] of the new vertices, in the head's order.
    """
    corners = torch.stack((head.faces, head.uv_faces, *(label[:, None].expand(-1, 3) for label in labels)), -1)
    distinct, place = corners.flatten(0, 1).unique(dim=0, return_inverse=True)
    return distinct, place.view(-1, 3)
