"""Cameras that frame a resting avatar: its head, or the portrait with its bust."""

from __future__ import annotations

import math
import warnings
from typing import Literal

import torch
from torch import Tensor

from uika.avatar.avatar import Avatar
from uika.errors import UikaError, UikaWarning
from uika.head import Camera, look_at
from uika.motion.motion import Motion

Framing = Literal["bust", "head"]

MIN_SIZE, MAX_SIZE = 16, 4096  # pixels, of a picture's side
FOV = 20.0  # degrees; a portrait lens
_MARGIN = 1.14  # frame over head, so that nods and an open jaw stay inside
_BUST_MARGIN = 1.06  # frame over bust, which does not move
_FADE = 0.015  # metres above the end of a bust where its picture ends: below, it is transparent
_STRAYS = 0.002  # share of the Gaussians that the frame may ignore at each end


def neutral_camera(
    avatar: Avatar, yaw: float = 0.0, pitch: float = 0.0, size: int = 512, frame: Framing = "bust"
) -> Camera:
    """A camera whose frame the whole resting avatar fills, hair and neck included, from any side.

    Args:
        avatar: the avatar.
        yaw: degrees, positive moves the camera to the subject's left.
        pitch: degrees in (-90, 90), positive moves the camera up.
        size: side of the square picture in pixels.
        frame: "bust" shows the shoulders too, where the avatar has them; "head" does not.

    Raises:
        UikaError: an angle or the size is out of range.
    """
    return _view(target_and_distance(avatar, frame), yaw, pitch, size)


def motion_cameras(avatar: Avatar, motion: Motion, size: int = 512, frame: Framing = "bust") -> Camera:
    """The cameras [T] of a motion: `neutral_camera` along the motion's path, or from the front where it has none.

    Warns (`UikaWarning`) of a motion whose translation takes the head out of their pictures.
    """
    rest = torch.zeros(len(motion))
    yaw = rest if motion.yaw is None else motion.yaw
    pitch = rest if motion.pitch is None else motion.pitch
    framed = target_and_distance(avatar, frame)
    seen: dict[tuple[float, float], Camera] = {}
    for view in zip(yaw.tolist(), pitch.tolist(), strict=True):
        if view not in seen:
            seen[view] = _view(framed, *view, size)
    path = Camera.stack([seen[view] for view in zip(yaw.tolist(), pitch.tolist(), strict=True)])
    _warn_of_absence(framed[0] + motion.translation, path)
    return path


def _warn_of_absence(centres: Tensor, path: Camera) -> None:
    """Say so if the head's centre [T,3] lies outside the pictures of T cameras."""
    seen = torch.einsum("tij,tj->ti", path.viewmat[:, :3, :3], centres) + path.viewmat[:, :3, 3]
    place = torch.einsum("tij,tj->ti", path.K, seen)
    inside = (place[:, :2] >= 0) & (place[:, :2] <= place[:, 2:] * torch.tensor([path.width, path.height]))
    absent = (~(inside.all(-1) & (seen[:, 2] > 0))).nonzero()[:, 0].tolist()
    if absent:
        warnings.warn(
            f"the motion's translation takes the head out of the picture in {len(absent)} of {len(centres)} frames, "
            f"first in frame {absent[0]}; translations are metres from the head's place at rest",
            UikaWarning,
            stacklevel=3,
        )


def target_and_distance(avatar: Avatar, frame: Framing = "bust") -> tuple[Tensor, float]:
    """What `neutral_camera` looks at [3], and the distance in metres from which it fills the picture."""
    bust = avatar.on_bust
    whole = frame == "bust" and bool(bust.any())
    means = avatar.means if whole else avatar.means[~bust]
    ends = torch.tensor([_STRAYS, 1 - _STRAYS])
    low, high = torch.quantile(means, ends, dim=0)
    if whole:
        low[1] = means[:, 1].min() + _FADE
    centre = (low + high) / 2
    reach = (means[:, [0, 2]] - centre[[0, 2]]).norm(dim=-1)
    radius = max(float(torch.quantile(reach, 1 - _STRAYS)), float(high[1] - low[1]) / 2)
    radius *= _BUST_MARGIN if whole else _MARGIN
    if whole:
        centre[1] = low[1] + radius  # a bust goes on to the picture's lower edge
    return centre, radius / math.tan(math.radians(FOV / 2))


def _view(frame: tuple[Tensor, float], yaw: float, pitch: float, size: int) -> Camera:
    check_view(yaw, pitch, size)
    centre, distance = frame
    return look_at(yaw, pitch, distance, centre, fov_y=FOV, size=size)


def check_view(yaw: float, pitch: float, size: int) -> None:
    """Refuse a view that cannot be rendered.

    Raises:
        UikaError: an angle is not finite, the camera would look straight down or up, or the size is out of range.
    """
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise UikaError(f"size must lie between {MIN_SIZE} and {MAX_SIZE} pixels, not {size}")
    if not math.isfinite(yaw):
        raise UikaError(f"yaw must be a finite number of degrees, not {yaw}")
    if not abs(pitch) < 90:
        raise UikaError(f"pitch must lie between -90 and 90 degrees, not {pitch:g}")
