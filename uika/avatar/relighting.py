"""An avatar under another light: its colours over what its own light gives them, times what the new one gives."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.avatar import Avatar
from uika.avatar.avatar import AvatarError
from uika.head import HeadModel, vertex_normals
from uika.head.light import COUNT, from_environment, received, to_linear, to_srgb

_STUDIO = ((-0.7, 0.5, 0.7), 4.5, 8.0), ((0.9, 0.1, 0.6), 0.6, 3.0), ((0.3, 0.6, -0.8), 1.5, 8.0)
_ROOM = 0.2  # radiance of the walls around the lamps
_HEIGHT = 64  # rows of the picture of the studio


@torch.no_grad()
def relit(avatar: Avatar, head: HeadModel, light: Tensor, *, exposed: bool = True) -> Avatar:
    """The avatar under `light`, which stays fixed to the head.

    Args:
        avatar: must know the light that its colours are kept under.
        head: the head model.
        light: [9,3] as of `uika.head.light.from_environment`.
        exposed: brighten or darken the light so that the front of the head is as bright as before, as a camera's
            exposure would; otherwise the light is taken as it is, for colours that are reflectances under it.

    Raises:
        AvatarError: the avatar does not know its light, or was made for another head.
    """
    if avatar.light is None:
        raise AvatarError("the avatar does not know the light of its photos; make it again to relight it")
    if light.shape != (COUNT, 3) or not bool(torch.isfinite(light).all()):
        raise AvatarError(f"the light must be {COUNT}x3 finite numbers, got {list(light.shape)}")
    normals = splat_normals(avatar, head)
    if exposed:
        light = light * _exposure(normals, avatar.light, light)
    factor = received(light, normals) / received(avatar.light, normals)
    return replace(avatar, colors=to_srgb(to_linear(avatar.colors) * factor), light=light)


def splat_normals(avatar: Avatar, head: HeadModel) -> Tensor:
    """Unit normals [M,3] of the resting surface below each Gaussian."""
    vertices = avatar.canonical_vertices(head)
    faces = head.faces if len(vertices) == len(head.template) else head.without_bust.faces
    corners = vertex_normals(vertices, faces)[faces[avatar.triangle]]
    return normalize((corners * avatar.barycentric[..., None]).sum(1), dim=-1, eps=1e-20)


def studio_light() -> Tensor:
    """A large lamp above the subject's right, a weaker one at the left and one behind, in a grey room; [9,3]."""
    polar = torch.pi * (torch.arange(_HEIGHT) + 0.5) / _HEIGHT
    around = torch.pi * (1 - (torch.arange(2 * _HEIGHT) + 0.5) / _HEIGHT)
    level = polar[:, None].expand(-1, len(around))
    turn = around.expand(len(polar), -1)
    directions = torch.stack((level.sin() * turn.sin(), level.cos(), level.sin() * turn.cos()), -1)
    picture = torch.full(directions.shape[:2], _ROOM)
    for toward, radiance, sharpness in _STUDIO:
        lamp = normalize(torch.tensor(toward), dim=0)
        picture = picture + radiance * torch.exp(sharpness * (directions @ lamp - 1))
    return from_environment(picture[..., None].expand(-1, -1, 3))


def _exposure(normals: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Factor that gives the front of a head the mean level that it had."""
    front = normals[:, 2].clamp_min(0)[:, None]
    old, new = ((front * received(light, normals)).sum() for light in (before, after))
    return old / new.clamp_min(1e-9)
