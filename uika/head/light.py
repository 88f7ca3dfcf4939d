"""Light of low order: what a matt surface receives is a sum of nine functions of its normal."""

from __future__ import annotations

import math

import torch
from torch import Tensor

COUNT = 9
_SHADE = 0.25  # least light that a surface receives, over the mean: where the fit knows nothing it must not divide by 0
# Shares of each order that a matt surface passes on: irradiance over pi from radiance.
_PASSED = (1.0, *(2 / 3,) * 3, *(1 / 4,) * 5)


def harmonics(directions: Tensor) -> Tensor:
    """Real spherical harmonics [...,9] up to order 2 of unit directions [...,3], orthonormal over the sphere."""
    x, y, z = directions.unbind(-1)
    first, second = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    return torch.stack(
        (
            torch.full_like(x, 0.5 / math.sqrt(math.pi)),
            first * y,
            first * z,
            first * x,
            second * x * y,
            second * y * z,
            0.25 * math.sqrt(5 / math.pi) * (3 * z * z - 1),
            second * x * z,
            0.5 * second * (x * x - y * y),
        ),
        -1,
    )


def from_environment(picture: Tensor) -> Tensor:
    """The light [9,3] that an environment casts on matt surfaces: `harmonics(normal) @ light` is irradiance over pi.

    Args:
        picture: [H,W,3] linear radiance, latitude and longitude, as Mitsuba has them: the top row lies above (+Y), the
            middle column before the face (+Z), and columns go on towards -X, the subject's right.
    """
    height, width = picture.shape[:2]
    polar = math.pi * (torch.arange(height) + 0.5) / height
    around = 2 * math.pi * (0.5 - (torch.arange(width) + 0.5) / width)
    sine = torch.sin(polar)[:, None]
    directions = torch.stack(
        (sine * torch.sin(around), torch.cos(polar)[:, None].expand(height, width), sine * torch.cos(around)), -1
    )
    area = (sine * (math.pi / height) * (2 * math.pi / width))[..., None]
    radiance = torch.einsum("hwk,hwc->kc", harmonics(directions), picture.float() * area)
    return radiance * torch.tensor(_PASSED)[:, None]


def received(light: Tensor, normals: Tensor) -> Tensor:
    """What surfaces with unit normals [M,3] receive of a light [9,3], [M,3], at least a share of its mean."""
    amount = harmonics(normals) @ light
    mean = light[0] * harmonics(normals[:1])[0, 0]
    return torch.maximum(amount, _SHADE * mean)


def to_linear(srgb: Tensor) -> Tensor:
    """Linear light of sRGB in [0,1]."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Tensor) -> Tensor:
    """The sRGB of linear light, cut to [0,1]."""
    light = linear.clamp(0, 1)
    return torch.where(light <= 0.0031308, light * 12.92, 1.055 * light.clamp_min(1e-8) ** (1 / 2.4) - 0.055)
