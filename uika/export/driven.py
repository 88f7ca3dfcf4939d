"""What a page needs to drive a face that it was not made with: what each action does to each vertex."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.export.vertex_motion import vertex_motion
from uika.head import HeadModel
from uika.head.actions import ARKIT_ACTIONS
from uika.motion import Motion

_STILL = (2e-5, 1e-3)  # metres, and radians / 2 or growth: vertices that an action moves less are left out
_STEPS = 32767
_MOST = 120  # actions: FLAME's 100 expressions fit


def driven_names(head: HeadModel) -> list[str]:
    """The expressions that a page can drive, those of ARKit first."""
    names = [name for name in ARKIT_ACTIONS if name in head.expression_names]
    return [*names, *(name for name in head.expression_names if name not in names)][:_MOST]


def driven_arrays(avatar: Avatar, head: HeadModel) -> dict[str, NDArray[Any]]:
    """Rest pose, neck weights, and for each of `driven_names` the vertices that it moves.

    Of each vertex eight numbers count: position (metres), growth and rotation (quaternion wxyz) of what sits on it.
    Actions are added up, which is exact for positions and holds for the small rotations of a face.
    """
    names = driven_names(head)
    expression = torch.zeros(1 + len(names), len(head.expression_names))
    for row, name in enumerate(names, 1):
        expression[row, head.expression_names.index(name)] = 1
    still = torch.zeros(len(expression), 3)
    motion = Motion(expression, still, still, still, torch.zeros(len(expression), 6), still, 1.0)
    rows = vertex_motion(avatar, motion, head)
    rest, moved = rows[0], rows[1:] - rows[0]
    limit = torch.tensor([_STILL[0]] * 3 + [_STILL[1]] * 5)
    found = [(change.abs() > limit).any(-1).nonzero()[:, 0] for change in moved]
    steps = (moved.abs().amax(1) / _STEPS).clamp_min(1e-12)
    values = [(moved[k, ids] / steps[k]).round() for k, ids in enumerate(found)]
    start = np.cumsum([0, *map(len, found)])
    index: Tensor = torch.cat(found)
    return {
        "driveRest": rest.numpy(),
        "driveStart": start.astype(np.uint32),
        "driveVertex": index.numpy().astype(np.uint32 if len(rest) > 65536 else np.uint16),
        "driveValue": torch.cat(values).short().numpy(),
        "driveStep": steps.numpy(),
        "neckWeight": ((1 - head.lbs_weights[:, 0]).clamp(0, 1) * 255).round().byte().numpy(),
    }
