"""Half as many Gaussians for small pictures: neighbours in the atlas become one that covers both."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.head import Camera
from uika.head.rotations import matrices_to_quaternions, quaternions_to_matrices

NEAR = 2.5  # times the mean of both scales: what lies farther apart is not merged
SPREAD = 2.0  # of the pair's distance in its covariance: by both Gaussians alone (1) skin shows a grain of gaps
ALIKE = 0.12  # sRGB: largest difference of colours that are merged
_MOST = 0.99  # opacity
_PIXEL = 1.1  # pixels: a median Gaussian that is smaller is finer than the picture

Level = Literal["auto", "full", "half"]


def at_level(avatar: Avatar, level: Level, camera: Camera) -> Avatar:
    """The avatar or its half; `auto` takes the half where the camera's pixels are larger than the Gaussians."""
    if avatar.skinning == "released":  # is bound by weights of its own
        return avatar
    if level == "auto":
        distance = float((camera.viewmat[:3, :3] @ avatar.means.mean(0) + camera.viewmat[:3, 3])[2])
        pixels = float(avatar.scales.amax(-1).median() * camera.K[0, 0]) / max(distance, 1e-6)
        level = "half" if pixels < _PIXEL else "full"
    return halved(avatar) if level == "half" else avatar


def halved(avatar: Avatar) -> Avatar:
    """An avatar in which each Gaussian and its neighbour in the atlas's row are one, where they are near and alike.

    Mean and covariance are those of both together, weighted by opacity times area; what both cover stays covered. The
    merged Gaussian is bound where the first of the two was.

    Returns:
        An avatar of 50 to 100 % of the Gaussians; looks the same where a pixel is larger than a Gaussian.
    """
    first = _pairs(avatar)
    alone = torch.ones(len(avatar), dtype=torch.bool)
    alone[first] = alone[first + 1] = False
    parts = [_area(avatar, index) * avatar.opacities.flatten()[index] for index in (first, first + 1)]
    total = parts[0] + parts[1]
    share = torch.stack(parts) / total.clamp_min(1e-12)
    means = torch.stack((avatar.means[first], avatar.means[first + 1]))
    mean = (share[..., None] * means).sum(0)
    covariance = torch.zeros(len(first), 3, 3)
    for weight, centre, index in zip(share, means, (first, first + 1), strict=True):
        away = centre - mean
        both_ways = SPREAD * away[:, :, None] * away[:, None, :]
        covariance += weight[:, None, None] * (_covariances(avatar, index) + both_ways)
    spread, axes = torch.linalg.eigh(covariance)
    axes[..., 0] *= torch.linalg.det(axes).sign()[:, None]
    merged = {
        "means": mean,
        "quats": matrices_to_quaternions(axes),
        "scales": spread.clamp_min(1e-14).sqrt(),
        "colors": (share[..., None] * torch.stack((avatar.colors[first], avatar.colors[first + 1]))).sum(0),
        "triangle": avatar.triangle[first],
        "barycentric": avatar.barycentric[first],
    }
    merged["opacities"] = (total / (merged["scales"][:, 1] * merged["scales"][:, 2])).clamp(max=_MOST)
    order = torch.cat((first, alone.nonzero()[:, 0])).argsort()
    fields: dict[str, Any] = {
        name: torch.cat((value.to(getattr(avatar, name).dtype), getattr(avatar, name)[alone]))[order]
        for name, value in merged.items()
    }
    return dataclasses.replace(avatar, **fields)


def _pairs(avatar: Avatar) -> Tensor:
    """The first index of each pair of neighbours in the list that are near, alike and in no other pair."""
    apart = (avatar.means[1:] - avatar.means[:-1]).norm(dim=-1)
    size = avatar.scales.amax(-1)
    linked = apart <= NEAR * (size[1:] + size[:-1]) / 2
    linked &= (avatar.colors[1:] - avatar.colors[:-1]).abs().amax(-1) <= ALIKE
    index = torch.arange(len(linked))
    begins = linked & ~torch.cat((torch.zeros(1, dtype=torch.bool), linked[:-1]))
    start = torch.where(begins, index, torch.zeros_like(index)).cummax(0).values
    return index[linked & ((index - start) % 2 == 0)]


def _area(avatar: Avatar, index: Tensor) -> Tensor:
    largest = avatar.scales[index].topk(2, -1).values
    return largest[:, 0] * largest[:, 1]


def _covariances(avatar: Avatar, index: Tensor) -> Tensor:
    turned = quaternions_to_matrices(avatar.quats[index]) * avatar.scales[index][:, None, :]
    return turned @ turned.mT
