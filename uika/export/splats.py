"""The Gaussians that a file holds, and the axes that its readers assume."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import HeadModel, HeadParameters


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians in world space; float32, activated."""

    means: Tensor  # [N,3] metres
    quats: Tensor  # [N,4] wxyz
    scales: Tensor  # [N,3] metres, standard deviations
    opacities: Tensor  # [N] in [0,1]
    colors: Tensor  # [N,3] sRGB in [0,1]

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.means)

    def half_turned(self) -> Splats:
        """Turned by 180 degrees about Z: Y up becomes Y down and back; the face keeps looking along +Z."""
        w, x, y, z = self.quats.unbind(-1)
        means = self.means * self.means.new_tensor([-1.0, -1.0, 1.0])
        return dataclasses.replace(self, means=means, quats=torch.stack((-z, -y, x, w), -1))

    def turned_over(self) -> Splats:
        """Turned by 180 degrees about X: from right, up, back to right, down, forward and back."""
        w, x, y, z = self.quats.unbind(-1)
        means = self.means * self.means.new_tensor([1.0, -1.0, -1.0])
        return dataclasses.replace(self, means=means, quats=torch.stack((-x, w, -z, y), -1))


def posed_splats(avatar: Avatar, head: HeadModel, params: HeadParameters | None = None) -> Splats:
    """An avatar's Gaussians in head space (Y up).

    Args:
        avatar: the avatar.
        head: the head model that it was made for.
        params: expression and pose of one frame; None keeps the canonical Gaussians.

    Raises:
        AvatarError: the head model is another one.
    """
    avatar.check_head(head)
    means, quats, scales = avatar.means, avatar.quats, avatar.scales
    if params is not None:
        means, quats, scales = avatar.pose(params, head)
    return Splats(means, quats, scales, avatar.opacities, avatar.colors)


def thinned(avatar: Avatar, count: int) -> Avatar:
    """At most `count` of an avatar's Gaussians, evenly spaced and widened so that they still cover the surface.

    Raises:
        UikaError: `count` is less than 1.
    """
    if count < 1:
        raise UikaError(f"count must be at least 1, not {count}")
    if count >= len(avatar):
        return avatar
    # Gaussians follow the rows of the atlas, so that even steps through the list are even steps on the surface.
    kept = torch.arange(count) * len(avatar) // count
    names = ("means", "quats", "opacities", "colors", "triangle", "barycentric")
    wider = avatar.scales[kept] * (len(avatar) / count) ** 0.5
    return dataclasses.replace(avatar, scales=wider, **{name: getattr(avatar, name)[kept] for name in names})
