"""Training losses (paper section 3.4), all means over their elements."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

_WINDOW, _SIGMA = 11, 1.5
SSIM_REACH = _WINDOW // 2  # pixels beside one that its similarity depends on
_PLACE = torch.arange(_WINDOW, dtype=torch.float64) - SSIM_REACH
SSIM_WINDOW = torch.softmax(-_PLACE.square() / (2 * _SIGMA**2), 0)  # a Gaussian that sums to 1
_C1, _C2 = 0.01**2, 0.03**2
_MIN_SIDE = 8  # pixels, of the coarsest level that gradients are compared on
_SURE = 1e-6


def l1(image: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (image - reference).abs().mean()


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


def ssim_loss(image: Tensor, reference: Tensor) -> Tensor:
    """1 - SSIM of images [N,C,H,W]; the paper prints SSIM itself, which grows as the images come closer."""
    return 1 - ssim_map(image, reference).mean()


def gradient_loss(image: Tensor, reference: Tensor, levels: int = 4) -> Tensor:
    """Absolute difference of the images' gradients on several scales, the stand-in for LPIPS that needs no weights.

    Each level halves the image; the mean is over levels and axes. It punishes blur, which L1 alone does not, but unlike
    LPIPS it knows nothing of what a picture shows. Images [N,C,H,W].
    """
    terms = []
    difference = image - reference  # gradients and means are linear
    for level in range(levels):
        if level:
            difference = functional.avg_pool2d(difference, 2)
        terms += [difference.diff(dim=2).abs().mean(), difference.diff(dim=3).abs().mean()]
        if min(difference.shape[2:]) < 2 * _MIN_SIDE:
            break
    return torch.stack(terms).mean()


def offset_loss(offsets: Tensor) -> Tensor:
    """Mean square of the offsets [...,3] in metres.

    The paper prints ||max(offset, eps)||: taken literally, a negative component becomes the constant eps and has no
    gradient, so that Gaussians could drift freely along the negative axes. The norm of the offset itself treats both
    directions alike; the released model does the same.
    """
    return offsets.square().mean()


def opacity_entropy(opacities: Tensor) -> Tensor:
    """Mean binary entropy of opacities in [0,1], which draws them to 0 or 1; not in the paper, released weight 0.05."""
    p = opacities.float().clamp(_SURE, 1 - _SURE)
    return -(p * p.log() + (1 - p) * (1 - p).log()).mean()


def alpha_loss(alpha: Tensor, mask: Tensor) -> Tensor:
    """Mean absolute difference between rendered coverage and the person's mask."""
    return l1(alpha, mask)


def variation(maps: Tensor) -> Tensor:
    """Mean squared difference of neighbouring values of maps [...,H,W], vertical and horizontal added."""
    return maps.diff(dim=-2).square().mean() + maps.diff(dim=-1).square().mean()


def _blur(images: Tensor) -> Tensor:
    window = SSIM_WINDOW.to(images).expand(images.shape[1], 1, 1, _WINDOW)
    across = functional.conv2d(images, window, padding=(0, SSIM_REACH), groups=images.shape[1])
    return functional.conv2d(across, window.mT, padding=(SSIM_REACH, 0), groups=images.shape[1])
