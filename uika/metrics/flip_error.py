"""LDR-FLIP (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images"): no weights, seen error.

The pictures are blurred as the eye does at a viewing distance, compared as colours, and the result is raised where
edges or points differ. The constants are those of the paper; equation numbers are the paper's.
"""

from __future__ import annotations

import math

import torch
from scipy.ndimage import correlate1d
from torch import Tensor

from uika.metrics.image import check_pair, chosen

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180  # 0.7 m from a display of 0.7 m and 3840 pixels

# Contrast sensitivity of the channels (table 1): weights and squared widths of two Gaussians, degrees.
_SENSITIVITY = (
    ((1.0, 0.0047), (0.0, 1e-5)),  # luminance
    ((1.0, 0.0053), (0.0, 1e-5)),  # red-green
    ((34.1, 0.04), (13.5, 0.025)),  # blue-yellow
)
_WIDEST = 0.04
_FEATURE_WIDTH = 0.082  # degrees
_COLOUR_POWER, _KNEE, _KNEE_VALUE, _FEATURE_POWER = 0.7, 0.4, 0.95, 0.5
_TO_XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)


def flip(
    image: Tensor, reference: Tensor, mask: Tensor | None = None, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> float:
    """Mean of `flip_map` over all pixels, or over those of `mask` [H,W] bool; 0 for equal pictures, at most 1."""
    return float(chosen(flip_map(image, reference, pixels_per_degree), mask).mean())


def flip_map(image: Tensor, reference: Tensor, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Tensor:
    """Error of every pixel.

    Args:
        image: [H,W,3] sRGB in [0,1].
        reference: [H,W,3].
        pixels_per_degree: of visual angle; depends on the viewing distance.

    Returns:
        [H,W] float64 in [0,1].

    Raises:
        ValueError: the shapes differ, or the pictures have no three channels.
    """
    check_pair(image, reference)
    if image.shape[2] != 3 or not pixels_per_degree > 0:
        raise ValueError(f"flip needs pictures [H,W,3] and positive pixels_per_degree, got {list(image.shape)}")
    pair = torch.stack((image, reference)).double().permute(0, 3, 1, 2).clamp(0, 1)
    opponent = _opponent(_xyz(_linear(pair)))
    colour = _colour_error(_blurred(opponent, pixels_per_degree))
    feature = _feature_error((opponent[:, :1] + 16) / 116, pixels_per_degree)
    return colour ** (1 - feature)


def _linear(srgb: Tensor) -> Tensor:
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def _xyz(linear: Tensor) -> Tensor:
    return torch.einsum("ij,njhw->nihw", linear.new_tensor(_TO_XYZ), linear)


def _white(like: Tensor) -> Tensor:
    return like.new_tensor(_TO_XYZ).sum(1)[:, None, None]


def _opponent(xyz: Tensor) -> Tensor:
    """YCxCz (equation 1): CIELAB without its cube root."""
    x, y, z = (xyz / _white(xyz)).unbind(1)
    return torch.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), 1)


def _from_opponent(opponent: Tensor) -> Tensor:
    first, second, third = opponent.unbind(1)
    y = (first + 16) / 116
    return torch.stack((y + second / 500, y, y - third / 200), 1) * _white(opponent)


def _lab(xyz: Tensor) -> Tensor:
    ratio = xyz / _white(xyz)
    edge = 6 / 29
    root = torch.where(ratio > edge**3, ratio.clamp_min(edge**3) ** (1 / 3), ratio / (3 * edge**2) + 4 / 29)
    x, y, z = root.unbind(1)
    return torch.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), 1)


def _blurred(opponent: Tensor, pixels_per_degree: float) -> Tensor:
    """Linear RGB [2,3,H,W] as the eye resolves it (section 4.1.1), clipped to what a display can show."""
    radius = math.ceil(3 * math.sqrt(_WIDEST / (2 * math.pi**2)) * pixels_per_degree)
    place = (torch.arange(-radius, radius + 1, dtype=opponent.dtype) / pixels_per_degree).square()
    seen = []
    for channel, terms in zip(opponent.split(1, dim=1), _SENSITIVITY, strict=True):
        total, weight = torch.zeros_like(channel), torch.zeros((), dtype=channel.dtype)
        for amount, width in terms:
            if not amount:
                continue
            line = (-(math.pi**2) * place / width).exp()
            scale = amount * math.sqrt(math.pi / width)
            total = total + scale * _filtered(channel, line, line)
            weight = weight + scale * line.sum() ** 2
        seen.append(total / weight)
    xyz = _from_opponent(torch.cat(seen, 1))
    inverse = torch.linalg.inv(xyz.new_tensor(_TO_XYZ))
    return torch.einsum("ij,njhw->nihw", inverse, xyz).clamp(0, 1)


def _filtered(channel: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """A separable correlation of [2,1,H,W], with the border's pixels repeated outwards."""
    rows = correlate1d(channel.numpy(), across.numpy(), axis=-1, mode="nearest")
    return torch.from_numpy(correlate1d(rows, down.numpy(), axis=-2, mode="nearest"))


def _colour_error(linear: Tensor) -> Tensor:
    """Sections 4.1.2 and 4.1.3: HyAB distance of Hunt-adjusted colours, compressed to [0,1]."""
    error = _distance(_hunt(_lab(_xyz(linear)))) ** _COLOUR_POWER
    extremes = linear.new_tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[:, :, None, None]  # green and blue
    most = float(_distance(_hunt(_lab(_xyz(extremes))))) ** _COLOUR_POWER
    knee = _KNEE * most
    low = _KNEE_VALUE / knee * error
    return torch.where(error < knee, low, _KNEE_VALUE + (error - knee) / (most - knee) * (1 - _KNEE_VALUE))


def _hunt(lab: Tensor) -> Tensor:
    """Colours fade where it is dark."""
    return torch.cat((lab[:, :1], 0.01 * lab[:, :1] * lab[:, 1:]), 1)


def _distance(lab: Tensor) -> Tensor:
    difference = lab[0] - lab[1]
    return difference[0].abs() + torch.hypot(difference[1], difference[2])


def _feature_error(luminance: Tensor, pixels_per_degree: float) -> Tensor:
    """Section 4.2: how differently edges and points show in luminance [2,1,H,W], in [0,1]."""
    deviation = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = math.ceil(3 * deviation)
    place = torch.arange(-radius, radius + 1, dtype=luminance.dtype)
    smooth = (-place.square() / (2 * deviation**2)).exp()
    smooth = smooth / smooth.sum()
    differences = []
    for shape in (-place, place.square() / deviation**2 - 1):
        line = shape * smooth
        # Rising and falling parts weigh the same, whatever the sampling.
        line = torch.where(line > 0, line / line.clamp_min(0).sum(), line / -line.clamp_max(0).sum())
        strength = torch.hypot(_filtered(luminance, line, smooth), _filtered(luminance, smooth, line))[:, 0]
        differences.append((strength[0] - strength[1]).abs())
    return (torch.maximum(*differences) / math.sqrt(2)) ** _FEATURE_POWER
