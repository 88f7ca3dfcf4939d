"""Whether two avatars are the same but for rounding."""

from dataclasses import replace
from typing import Any

import torch

from uika.avatar import Avatar

FEW = 1e-3  # of all values


def assert_same_avatar(one: Avatar, other: Avatar) -> None:
    """Threads may sum in another order, and a last bit decides which triangle a pixel at an outline shows.

    So the surface must agree everywhere, and what was read off the pixels in all but a few values. A bust has more
    splats where it is well seen: a threshold decides about each, and the number may differ a little.
    """
    torch.testing.assert_close(one.identity, other.identity, rtol=0, atol=1e-3)
    torch.testing.assert_close(one.static_offset, other.static_offset, rtol=0, atol=1e-5)
    assert abs(len(one) - len(other)) <= FEW * len(one)
    one, other = (on_head(avatar) for avatar in (one, other))
    torch.testing.assert_close(one.means, other.means, rtol=0, atol=1e-4)
    turned = torch.where((one.quats * other.quats).sum(-1, keepdim=True) < 0, -other.quats, other.quats)
    changes = {name: getattr(one, name) - getattr(other, name) for name in ("scales", "opacities", "colors")}
    for name, change in {"quats": one.quats - turned, **changes}.items():
        assert (change.abs() > 1e-3).float().mean() <= FEW, name
        assert change.abs().max() <= 0.1, name


def on_head(avatar: Avatar) -> Avatar:
    """The avatar without its bust's splats."""
    kept = ~avatar.on_bust
    names = ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric")
    parts: dict[str, Any] = {name: getattr(avatar, name)[kept] for name in names}
    return replace(avatar, **parts)
