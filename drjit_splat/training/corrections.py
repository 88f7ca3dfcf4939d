"""What may differ from photo to photo besides the view: exposure, and errors of the cameras."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import TrainConfig

RATES = {"appearance": 1e-3, "poses": 1e-4}


def start(count: int, config: TrainConfig) -> dict[str, torch.nn.Parameter]:
    """Corrections of `count` photos that change nothing yet: affine colours [N,3,4], and turn and shift [N,6]."""
    found: dict[str, torch.nn.Parameter] = {}
    if config.appearance:
        found["appearance"] = torch.nn.Parameter(torch.eye(3, 4).repeat(count, 1, 1))
    if config.refine_poses:
        found["poses"] = torch.nn.Parameter(torch.zeros(count, 6))
    return found


def optimizers(corrections: dict[str, torch.nn.Parameter]) -> dict[str, torch.optim.Optimizer]:
    """One Adam for each kind of correction."""
    return {name: torch.optim.Adam([value], lr=RATES[name]) for name, value in corrections.items()}


def colors(image: Tensor, corrections: dict[str, torch.nn.Parameter], index: int) -> Tensor:
    """The image [H,W,3] in the colours of photo `index`."""
    if "appearance" not in corrections:
        return image
    affine = corrections["appearance"][index]
    return image @ affine[:, :3].T + affine[:, 3]


def view(viewmat: Tensor, corrections: dict[str, torch.nn.Parameter], index: int) -> Tensor:
    """The corrected world-to-camera matrix [4,4] of photo `index`."""
    if "poses" not in corrections:
        return viewmat
    turn, shift = corrections["poses"][index].split(3)
    zero = torch.zeros(())
    x, y, z = turn
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero)).view(3, 3)
    moved = torch.cat((torch.linalg.matrix_exp(skew), shift[:, None]), 1)
    return torch.cat((moved, torch.tensor([[0.0, 0.0, 0.0, 1.0]]))) @ viewmat
