"""Pictures of an avatar: posed on the CPU by torch, splatted by Dr.Jit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.framing import Framing, motion_cameras
from uika.errors import UikaError
from uika.head import Camera, HeadModel, HeadParameters, load_head
from uika.io.progress import counted
from uika.motion import Motion


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
    frame: Framing = "bust",
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
        frame: what is framed then, as in `neutral_camera`.
        progress: whether to show a progress bar on stderr.
    """
    model = load_head() if head is None else head
    path = motion_cameras(avatar, motion, size, frame) if cameras is None else cameras
    canonical = avatar.canonical_vertices(model)
    params = motion.parameters(avatar.identity)
    for index in counted(range(len(motion)), progress, len(motion), "frames"):
        camera = path[index]
        yield render(avatar, params[index], camera, model, background, canonical=canonical)


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
