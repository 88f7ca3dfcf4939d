"""Weight-free comparisons of pictures and masks."""

from __future__ import annotations

import torch
from torch import Tensor


def psnr(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for values in [0,1]: -10 log10 of the mean squared error.

    Args:
        image: [H,W,C] picture.
        reference: [H,W,C] truth.
        mask: [H,W] bool, the pixels that count; None counts all.

    Raises:
        ValueError: shapes differ or no pixel counts.
    """
    if image.shape != reference.shape:
        raise ValueError(
            f"image and reference must have one shape, got {list(image.shape)} and {list(reference.shape)}"
        )
    square = (image.double() - reference.double()).square()
    chosen = square if mask is None else square[mask]
    if chosen.numel() == 0:
        raise ValueError("mask: no pixel counts")
    return float(-10.0 * torch.log10(chosen.mean().clamp_min(1e-12)))


def mask_iou(first: Tensor, second: Tensor, threshold: float = 0.5) -> float:
    """Intersection over union of two soft masks [H,W], cut at `threshold`; 1 when both are empty."""
    a, b = first >= threshold, second >= threshold
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 1.0
