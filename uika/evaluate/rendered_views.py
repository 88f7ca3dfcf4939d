"""Inputs of the network for any number of views: the bundled portrait's avatar, photographed from around."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.framing import neutral_camera
from uika.avatar.rendering import render
from uika.canonical.surface import surface_texels
from uika.fitting import pixel_uv
from uika.fitting.fit import Fit
from uika.head import Camera, HeadModel, HeadParameters, load_head
from uika.model import SurfaceTexels
from uika.reconstruction import reconstruct

_YAW, _PITCH = 55.0, 12.0  # degrees to either side


@dataclass(frozen=True, eq=False)
class Views:
    """N views of one head as `Reconstructor.forward` takes them, and what is needed to render the result."""

    images: Tensor  # [1,N,3,S,S]
    masks: Tensor  # [1,N,1,S,S]
    pixel_uv: Tensor  # [1,N,2,S,S]
    pixel_weight: Tensor  # [1,N,1,S,S]
    texel: Tensor
    surface: SurfaceTexels
    cameras: Camera
    head: HeadModel
    avatar: Avatar

    def inputs(self, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, SurfaceTexels]:
        """The first `count` views."""
        rows = (self.images, self.masks, self.pixel_uv, self.pixel_weight)
        images, masks, uv, weight = (row[:, :count] for row in rows)
        return images, masks, uv, weight, self.texel, self.surface


def make_views(count: int, size: int = 512, map_size: int = 384, source: Path = PORTRAIT) -> Views:
    """Render `count` views of the avatar of a photo; every other one from the other side, the frontal one first."""
    head = load_head().without_bust
    avatar = reconstruct([source], head, "none").avatar
    cameras = [_camera(avatar, index, size) for index in range(count)]
    params = HeadParameters.zeros(head).replace(identity=avatar.identity)
    pictures = [render(avatar, params, camera, head) for camera in cameras]
    masks = torch.stack([picture.alpha for picture in pictures]).clamp(0, 1)
    masks = torch.where(masks > 0.02, masks, torch.zeros(()))
    fit = Fit(HeadParameters.stack([params] * count), Camera.stack(cameras), avatar.static_offset, torch.zeros(count))
    uv, valid, weight = pixel_uv(fit, head, masks)
    surface, binding = surface_texels(head, avatar.identity, avatar.static_offset, map_size)
    return Views(
        images=torch.stack([picture.rgb.permute(2, 0, 1) for picture in pictures])[None].clamp(0, 1),
        masks=masks[None, :, None],
        pixel_uv=torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)[None],
        pixel_weight=weight[None, :, None],
        texel=binding.texel,
        surface=surface,
        cameras=Camera.stack(cameras),
        head=head,
        avatar=avatar,
    )


def _camera(avatar: Avatar, index: int, size: int) -> Camera:
    """Spread over both sides by the golden ratio, so that any first N views cover the head."""
    place = (index * 0.618034) % 1.0
    yaw = 0.0 if index == 0 else _YAW * (2 * place - 1)
    return neutral_camera(avatar, yaw, _PITCH * math.sin(2.4 * index), size)
