"""Parts of the head whose colours do not mix, as labels of the atlas."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import Binding, HeadModel

REGIONS = ("eyeballs", "mouth_inner", "teeth")  # labelled 1, 2, 3; skin and hair are 0
EYEBALLS, MOUTH, TEETH = 1, 2, 3


def regions(head: HeadModel, binding: Binding) -> Tensor:
    """Labels [S,S] of the parts whose colours do not mix: 0 skin and hair, 1 eyeballs, 2 inner mouth, 3 teeth."""
    labels = torch.zeros(len(binding), 1, dtype=torch.int64)
    for index, name in enumerate(REGIONS):
        if name in head.masks:
            labels[mask_at_texels(head, binding, name) > 0.5] = index + 1
    return binding.to_map(labels)[0]


def at_texels(head: HeadModel, binding: Binding, values: Tensor) -> Tensor:
    """Vertex values [V,C] at the texels [M,C]."""
    return (values[head.faces[binding.triangle]] * binding.barycentric[..., None]).sum(1)


def mask_at_texels(head: HeadModel, binding: Binding, name: str) -> Tensor:
    """A mask of the head's vertices at the texels [M], in [0,1]."""
    return at_texels(head, binding, head.masks[name][:, None])[:, 0]
