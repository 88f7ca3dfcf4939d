"""Colours of splats corrected by how their picture differs from the photo: splats overlap, and so they blur."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.head import Camera, HeadModel, HeadParameters, project

BEHIND = 0.008  # metres behind the rendered depth from which a splat counts as hidden
SURE = 0.9  # matte, and share of a pixel in the photo, from which the photo tells a colour
MOST_GAIN = 1.6  # between the light of the photo and that of the avatar


def sharpened(
    avatar: Avatar,
    head: HeadModel,
    pose: HeadParameters,
    camera: Camera,
    image: Tensor,
    known: Tensor,
    which: Tensor,
    *,
    relit: bool,
) -> Avatar:
    """One step towards a picture that is as sharp as the photo.

    Args:
        avatar: the avatar.
        head: its head model.
        pose: of the avatar in the photo.
        camera: of the photo.
        image: [3,S,S] sRGB.
        known: [S,S] in [0,1], how surely a pixel shows the person.
        which: bool [M], the splats whose colours may change.
        relit: whether the avatar may be kept under another light than the photo's.
    """
    shown = render(avatar, pose, camera, head, depth=True)
    assert shown.depth is not None
    means = avatar.pose(pose, head)[0][which]
    pixels, depth = project(means, camera)
    row, column = (pixels[:, i].long().clamp(0, camera.width - 1) for i in (1, 0))
    seen = (depth < shown.depth[row, column] + BEHIND) & (known[row, column] > SURE)
    own = shown.rgb.permute(2, 0, 1)
    if relit:
        one, other = (picture[:, row, column][:, seen] for picture in (image, own))
        gain = (one * other).sum(1) / one.square().sum(1).clamp_min(1e-6)
        image = image * gain.clamp(1 / MOST_GAIN, MOST_GAIN)[:, None, None]
    error = image - own
    grid = (2 * pixels / camera.width - 1)[None, None]
    change = grid_sample(error[None], grid, align_corners=False)[0, :, 0].mT
    colors = avatar.colors.clone()
    colors[which] = (colors[which] + torch.where(seen[:, None], change, 0.0)).clamp(0, 1)
    return replace(avatar, colors=colors)
