"""Structural similarity of images (Wang et al. 2004)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

_WINDOW = 11  # pixels
_SIGMA = 1.5
SSIM_REACH = _WINDOW // 2  # pixels beside one that its similarity depends on
_PLACE = torch.arange(_WINDOW, dtype=torch.float64) - SSIM_REACH
SSIM_WINDOW = torch.softmax(-_PLACE.square() / (2 * _SIGMA**2), 0)  # a Gaussian that sums to 1
_C1 = 0.01**2
_C2 = 0.03**2


def ssim_map(image: Tensor, reference: Tensor, blur: Callable[[Tensor], Tensor] | None = None) -> Tensor:
    """Structural similarity of every pixel.

    A Gaussian window of 11 pixels (sigma 1.5) with zeros beyond the border, so that the map has the images' size.

    Args:
        image: [N,C,H,W] in [0,1].
        reference: [N,C,H,W].
        blur: the window's sums of images [...,H,W], without gradients where that is quicker.

    Returns:
        [N,C,H,W] in [-1,1], 1 where the images agree.

    Raises:
        ValueError: the shapes differ or are not [N,C,H,W].
    """
    if image.shape != reference.shape or image.ndim != 4:
        raise ValueError(
            f"ssim needs two images [N,C,H,W] of one shape, got {list(image.shape)}, {list(reference.shape)}"
        )
    count = len(image)
    stacked = torch.cat((image, reference, image * image, reference * reference, image * reference))
    first, second, first_square, second_square, product = (blur or _blur)(stacked).split(count)
    first_variance = (first_square - first * first).clamp_min(0)
    second_variance = (second_square - second * second).clamp_min(0)
    covariance = product - first * second
    likeness = (2 * first * second + _C1) * (2 * covariance + _C2)
    return likeness / ((first * first + second * second + _C1) * (first_variance + second_variance + _C2))


def _blur(images: Tensor) -> Tensor:
    window = SSIM_WINDOW.to(images).expand(images.shape[1], 1, 1, _WINDOW)
    across = functional.conv2d(images, window, padding=(0, SSIM_REACH), groups=images.shape[1])
    return functional.conv2d(across, window.mT, padding=(SSIM_REACH, 0), groups=images.shape[1])
