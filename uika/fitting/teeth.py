"""Teeth stand right behind the lips: a head model whose rows lie deep in the mouth shows none of them when it opens."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import HeadModel
from uika.head.mesh_parts import upper_teeth

_UPPER_LIP = 13  # face mesh point on the inner edge of the upper lip
BEHIND = 0.0065  # metres from that edge back to the front of the upper row
BELOW = 0.004  # metres from that edge down to the end of the upper row
OVERBITE = 0.0015  # metres by which the upper row stands before the lower one


def teeth_offset(head: HeadModel) -> Tensor:
    """Displacements [V,3] in metres that bring both rows of teeth behind the lips; 0 for heads without teeth."""
    offset = torch.zeros_like(head.template)
    at = (head.landmark_ids == _UPPER_LIP).nonzero()
    if "teeth" not in head.masks or not len(at):
        return offset
    lip = head.landmarks(head.template)[int(at[0])]
    upper = upper_teeth(head)
    lower = (head.masks["teeth"] > 0.5) & ~upper
    if not bool(upper.any()) or not bool(lower.any()):
        return offset
    front, end = head.template[upper, 2].max(), head.template[upper, 1].min()
    offset[upper, 1] = (lip[1] - BELOW - end).clamp(max=0)
    offset[upper, 2] = (lip[2] - BEHIND - front).clamp(min=0)
    offset[lower, 2] = (lip[2] - BEHIND - OVERBITE - head.template[lower, 2].max()).clamp(min=0)
    return offset
