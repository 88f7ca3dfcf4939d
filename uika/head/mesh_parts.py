"""Pieces of the head's mesh that hang together: eyeballs, tongue, rows of teeth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from uika.head.model import HeadModel


@lru_cache(maxsize=4)
def mesh_parts(head: HeadModel) -> Tensor:
    """Label [V] of the connected piece that each vertex belongs to."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(head.template)
    row, column = torch.cat((head.faces[:, :2], head.faces[:, 1:])).numpy().T
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
    return torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))


def part_means(head: HeadModel, values: Tensor) -> Tensor:
    """Vertex values [V] averaged over the piece that each vertex belongs to."""
    part = mesh_parts(head)
    count = torch.bincount(part)
    return (torch.zeros(len(count)).index_add(0, part, values.float()) / count)[part]


def upper_teeth(head: HeadModel) -> Tensor:
    """Which vertices [V] are teeth of the upper row, which does not follow the jaw; none where teeth are unknown."""
    if "teeth" not in head.masks:
        return torch.zeros(len(head.template), dtype=torch.bool)
    teeth = head.masks["teeth"] > 0.5
    if "jawOpen" in head.expression_names:
        pull = -head.expression_basis[head.expression_names.index("jawOpen"), :, 1]
    else:
        pull = head.lbs_weights[:, 2]
    pull = part_means(head, pull)
    return teeth & (pull < 0.5 * pull[teeth].max())


def tongue(head: HeadModel) -> Tensor:
    """Which vertices [V] are a piece of its own inside the mouth that is no tooth; none where the mouth is unknown."""
    if "mouth_inner" not in head.masks:
        return torch.zeros(len(head.template), dtype=torch.bool)
    inner = head.masks["mouth_inner"] > 0.5
    if "teeth" in head.masks:
        inner = inner & (head.masks["teeth"] < 0.5)
    return part_means(head, inner) > 0.99
