"""Training losses (paper section 3.4), all means over their elements."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from uika.metrics.structural_similarity import ssim_map

_MIN_SIDE = 8  # pixels, of the coarsest level that gradients are compared on
_SURE = 1e-6


def l1(image: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (image - reference).abs().mean()


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
