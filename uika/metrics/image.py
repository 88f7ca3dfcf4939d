"""Weight-free comparisons of pictures and masks."""

from __future__ import annotations

import torch
from scipy.ndimage import correlate1d
from torch import Tensor

from uika.metrics.structural_similarity import SSIM_REACH, SSIM_WINDOW, ssim_map


def psnr(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for values in [0,1]: -10 log10 of the mean squared error.

    Args:
        image: [H,W,C] picture.
        reference: [H,W,C] truth.
        mask: [H,W] bool, the pixels that count; None counts all.

    Raises:
        ValueError: shapes differ or no pixel counts.
    """
    check_pair(image, reference)
    square = (image.double() - reference.double()).square()
    return float(-10.0 * torch.log10(chosen(square, mask).mean().clamp_min(1e-12)))


def ssim(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of pictures in [0,1], the mean over pixels and channels.

    The Gaussian window has sigma 1.5 and 11 pixels; pixels whose window leaves the picture do not count.

    Args:
        image: [H,W,C] picture.
        reference: [H,W,C] truth.
        mask: [H,W] bool, the pixels that count; None counts all.

    Raises:
        ValueError: shapes differ, the picture is smaller than the window, or no pixel counts.
    """
    inner = slice(SSIM_REACH, -SSIM_REACH)
    return float(chosen(ssim_pixels(image, reference), None if mask is None else mask[inner, inner]).mean())


def ssim_pixels(image: Tensor, reference: Tensor) -> Tensor:
    """The structural similarity of every pixel whose window lies inside, see `ssim`.

    Returns:
        [H-10,W-10,C] float64 in [-1,1].

    Raises:
        ValueError: shapes differ, or the picture is smaller than the window.
    """
    check_pair(image, reference)
    if min(image.shape[:2]) <= 2 * SSIM_REACH:
        raise ValueError(f"image: ssim needs more than {2 * SSIM_REACH} pixels a side, got {list(image.shape[:2])}")
    first, second = (picture.permute(2, 0, 1)[None].double() for picture in (image, reference))
    inner = slice(SSIM_REACH, -SSIM_REACH)
    return ssim_map(first, second, _blur)[0].permute(1, 2, 0)[inner, inner]


def _blur(images: Tensor) -> Tensor:
    # In float64, torch's convolutions take several times as long.
    window = SSIM_WINDOW.numpy()
    rows = correlate1d(images.numpy(), window, axis=-1, mode="constant")
    return torch.from_numpy(correlate1d(rows, window, axis=-2, mode="constant"))


def mask_iou(first: Tensor, second: Tensor, threshold: float = 0.5) -> float:
    """Intersection over union of two soft masks [H,W], cut at `threshold`; 1 when both are empty."""
    a, b = first >= threshold, second >= threshold
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 1.0


def check_pair(image: Tensor, reference: Tensor) -> None:
    """Make sure that two pictures [H,W,C] can be compared.

    Raises:
        ValueError: they differ in shape or are no pictures.
    """
    if image.shape != reference.shape or image.ndim != 3:
        raise ValueError(
            f"image and reference must be [H,W,C] of one shape, got {list(image.shape)} and {list(reference.shape)}"
        )


def chosen(values: Tensor, mask: Tensor | None) -> Tensor:
    """Values [H,W,...] of the pixels in a mask [H,W] bool, or all of them.

    Raises:
        ValueError: no pixel is in the mask.
    """
    picked = values if mask is None else values[mask]
    if picked.numel() == 0:
        raise ValueError("mask: no pixel counts")
    return picked
