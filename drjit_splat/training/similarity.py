"""Structural similarity (Wang et al. 2004) of small batches of images, for losses and figures."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

_SIDE, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(first: Tensor, second: Tensor) -> Tensor:
    """Mean similarity [] of images [H,W,3] in [0,1], windows beyond the border filled with zeros."""
    place = torch.arange(_SIDE, dtype=first.dtype) - _SIDE // 2
    window = torch.softmax(-(place**2) / (2 * _SIGMA**2), 0)
    stacked = torch.stack((first, second, first * first, second * second, first * second)).permute(0, 3, 1, 2)
    planes = stacked.reshape(-1, 1, *stacked.shape[2:])
    across = functional.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, _SIDE // 2))
    sums = functional.conv2d(across, window.view(1, 1, -1, 1), padding=(_SIDE // 2, 0)).view_as(stacked)
    a, b, aa, bb, ab = sums
    likeness = (2 * a * b + _C1) * (2 * (ab - a * b) + _C2)
    return (likeness / ((a * a + b * b + _C1) * ((aa - a * a) + (bb - b * b) + _C2))).mean()


def psnr(first: Tensor, second: Tensor) -> float:
    """Decibels between images [H,W,3] in [0,1]."""
    error = float((first - second).square().mean())
    return -10 * math.log10(max(error, 1e-12))
