"""Structural similarity (Wang et al. 2004) of two images, for losses and figures."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

_SIDE, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(first: Tensor, second: Tensor) -> Tensor:
    """Mean similarity [] of images [H,W,3] in [0,1], windows beyond the border filled with zeros.

    Only `first` gets a gradient.
    """
    value: Tensor = _Similarity.apply(first, second.detach())
    return value


def psnr(first: Tensor, second: Tensor) -> float:
    """Decibels between images [H,W,3] in [0,1]."""
    error = float((first - second).square().mean())
    return -10 * math.log10(max(error, 1e-12))


def _smooth(planes: Tensor) -> Tensor:
    """Each of the planes [P,H,W] under the window, which is its own adjoint.

    As channels of one image, each with a filter of its own, they take a tenth of the time that they take as a batch.
    """
    count = len(planes)
    place = torch.arange(_SIDE, dtype=planes.dtype) - _SIDE // 2
    window = torch.softmax(-(place**2) / (2 * _SIGMA**2), 0)
    row = window.view(1, 1, 1, -1).repeat(count, 1, 1, 1)
    across = functional.conv2d(planes[None], row, padding=(0, _SIDE // 2), groups=count)
    return functional.conv2d(across, row.mT.contiguous(), padding=(_SIDE // 2, 0), groups=count)[0]


class _Similarity(torch.autograd.Function):
    """The mean similarity with its derivative written out, which smooths three planes a channel instead of five."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        """The mean."""
        x, y = first.permute(2, 0, 1), second.permute(2, 0, 1)
        a, b, aa, bb, ab = _smooth(torch.cat((x, y, x * x, y * y, x * y))).chunk(5)
        means, spread = a * a + b * b + _C1, (aa - a * a) + (bb - b * b) + _C2
        along, together = 2 * a * b + _C1, 2 * (ab - a * b) + _C2
        below = 1 / (means * spread)
        likeness = along * together * below
        if ctx.needs_input_grad[0]:
            by_a = 2 * (b * (together - along) * below + a * likeness * (1 / spread - 1 / means))
            ctx.save_for_backward(first, second, by_a, -likeness / spread, 2 * along * below)
        return likeness.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None]:
        """Derivatives by the smoothed x, x^2 and x y, smoothed once more."""
        first, second, *parts = ctx.saved_tensors
        by_a, by_aa, by_ab = _smooth(torch.cat(parts)).permute(1, 2, 0).split(first.shape[-1], -1)
        return gradient / first.numel() * (by_a + 2 * first * by_aa + second * by_ab), None
