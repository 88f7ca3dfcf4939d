"""Pictures of an avatar: posed on the CPU by torch, splatted by Dr.Jit."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.errors import UikaError, UikaWarning
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at
from uika.io.progress import counted
from uika.motion import Motion

MIN_SIZE, MAX_SIZE = 16, 4096  # pixels, of a picture's side
_FOV = 20.0  # degrees; a portrait lens
_MARGIN = 1.14  # frame over head, so that nods and an open jaw stay inside
_STRAYS = 0.002  # share of the Gaussians that the frame may ignore at each end


class Rendering(NamedTuple):
    """One picture, float32."""

    rgb: Tensor  # [H,W,3] sRGB on the background
    alpha: Tensor  # [H,W] coverage in [0,1]
    depth: Tensor | None  # [H,W] metres along the view axis, 0 where nothing is; None unless asked for


def render(
    avatar: Avatar,
    params: HeadParameters,
    camera: Camera,
    head: HeadModel | None = None,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    depth: bool = False,
    canonical: Tensor | None = None,
) -> Rendering:
    """Render one frame.

    Args:
        avatar: the avatar.
        params: expression and pose of one frame; the avatar keeps its own identity.
        camera: one camera.
        head: the head model; None loads the one that `uika.head.load_head` finds.
        background: sRGB in [0,1].
        depth: whether to render the expected depth too.
        canonical: [V,3] `avatar.canonical_vertices(head)`, to save time over many frames.

    Raises:
        AvatarError: the head model is not the avatar's.
        UikaError: `params` or `camera` is a batch.
        RuntimeError: no LLVM library was found for Dr.Jit; the message says what to install.
    """
    if params.batch_shape or camera.viewmat.ndim != 2 or camera.K.ndim != 2:
        raise UikaError("render takes parameters and a camera without batch dimensions; index them first")
    from drjit_splat import rasterization

    model = load_head() if head is None else head
    means, quats, scales = avatar.pose(params, model, canonical)
    colors, alphas, _ = rasterization(
        means,
        quats,
        scales,
        avatar.opacities,
        avatar.colors,
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        backgrounds=torch.tensor([list(background)]),
        render_mode="RGB+ED" if depth else "RGB",
    )
    return Rendering(colors[0, ..., :3], alphas[0, ..., 0], colors[0, ..., 3] if depth else None)


def frames(
    avatar: Avatar,
    motion: Motion,
    cameras: Camera | None = None,
    head: HeadModel | None = None,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    size: int = 512,
    progress: bool = False,
) -> Iterator[Rendering]:
    """Render a motion frame by frame.

    Args:
        avatar: the avatar.
        motion: T frames.
        cameras: one camera for all frames or T of them; None frames the head and follows the motion's camera path.
        head: the head model; None loads the one that `uika.head.load_head` finds.
        background: sRGB in [0,1].
        size: side of the picture in pixels when `cameras` is None.
        progress: whether to show a progress bar on stderr.
    """
    model = load_head() if head is None else head
    path = motion_cameras(avatar, motion, size) if cameras is None else cameras
    canonical = avatar.canonical_vertices(model)
    params = motion.parameters(avatar.identity)
    for index in counted(range(len(motion)), progress, len(motion), "frames"):
        camera = path[index]
        yield render(avatar, params[index], camera, model, background, canonical=canonical)


def neutral_camera(avatar: Avatar, yaw: float = 0.0, pitch: float = 0.0, size: int = 512) -> Camera:
    """A camera whose frame the whole resting avatar fills, hair and neck included, from any side.

    Args:
        avatar: the avatar.
        yaw: degrees, positive moves the camera to the subject's left.
        pitch: degrees in (-90, 90), positive moves the camera up.
        size: side of the square picture in pixels.

    Raises:
        UikaError: an angle or the size is out of range.
    """
    return _view(_frame(avatar), yaw, pitch, size)


def motion_cameras(avatar: Avatar, motion: Motion, size: int = 512) -> Camera:
    """The cameras [T] of a motion: `neutral_camera` along the motion's path, or from the front where it has none.

    Warns (`UikaWarning`) of a motion whose translation takes the head out of their pictures.
    """
    rest = torch.zeros(len(motion))
    yaw = rest if motion.yaw is None else motion.yaw
    pitch = rest if motion.pitch is None else motion.pitch
    frame = _frame(avatar)
    seen: dict[tuple[float, float], Camera] = {}
    for view in zip(yaw.tolist(), pitch.tolist(), strict=True):
        if view not in seen:
            seen[view] = _view(frame, *view, size)
    path = Camera.stack([seen[view] for view in zip(yaw.tolist(), pitch.tolist(), strict=True)])
    _warn_of_absence(frame[0] + motion.translation, path)
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


def _frame(avatar: Avatar) -> tuple[Tensor, float]:
    """Centre [3] of the resting avatar and the distance in metres from which it fills the picture."""
    ends = torch.tensor([_STRAYS, 1 - _STRAYS])
    low, high = torch.quantile(avatar.means, ends, dim=0)
    centre = (low + high) / 2
    reach = (avatar.means[:, [0, 2]] - centre[[0, 2]]).norm(dim=-1)
    radius = max(float(torch.quantile(reach, 1 - _STRAYS)), float(high[1] - low[1]) / 2)
    return centre, _MARGIN * radius / math.tan(math.radians(_FOV / 2))


def _view(frame: tuple[Tensor, float], yaw: float, pitch: float, size: int) -> Camera:
    check_view(yaw, pitch, size)
    centre, distance = frame
    return look_at(yaw, pitch, distance, centre, fov_y=_FOV, size=size)


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


def check_renderer() -> None:
    """Start Dr.Jit now rather than after minutes of other work.

    Raises:
        UikaError: no usable LLVM library was found; the message says what to install.
    """
    from drjit_splat.llvm import require

    try:
        require()
    except RuntimeError as error:
        raise UikaError(str(error)) from error
