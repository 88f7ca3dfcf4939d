"""Many frames of one avatar as bytes, as fast as the processor allows: everything after the mesh runs in Dr.Jit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.framing import Framing, motion_cameras
from uika.avatar.level import Level, at_level
from uika.head import Camera, HeadModel, HeadParameters, load_head, pose_vertices
from uika.head.binding import rigid_turn
from uika.head.posing import rest_joints
from uika.io.progress import counted
from uika.motion import Motion

if TYPE_CHECKING:
    from drjit_splat.frames import Frame, ProjectedFrame
    from uika.avatar.rig import Posed


class PosedMesh(NamedTuple):
    """The head in one frame."""

    vertices: Tensor  # [V,3] metres
    turn: Tensor  # [4] wxyz, the rigid turn of the mesh
    centres: Tensor | None  # [M,3] metres of the Gaussians, of an avatar that is moved by skinning alone


_BLOCK = 16  # frames whose meshes are posed together: one product of matrices instead of many thin ones


class FrameRenderer:
    """An avatar ready to be filmed: its Gaussians, their binding and its own head, prepared once."""

    def __init__(
        self,
        avatar: Avatar,
        head: HeadModel,
        background: Sequence[float] = (1.0, 1.0, 1.0),
        closing: float | None = None,
    ) -> None:
        """Prepare; `closing` as in `drjit_splat.frames.project_frame`, None for its default.

        Raises:
            AvatarError: the head model is not the avatar's.
            RuntimeError: no LLVM library was found for Dr.Jit; the message says what to install.
        """
        from uika.avatar.rig import Rig

        self.canonical = avatar.canonical_vertices(head)
        self.rig = Rig.of(
            avatar.means,
            avatar.quats,
            avatar.scales,
            self.canonical,
            head.faces,
            avatar.triangle,
            avatar.barycentric,
        )
        self._head = _personal(head, avatar.identity, self.canonical)
        self._avatar, self._own_head = avatar, head
        self._still = (_flat(avatar.quats), _flat(avatar.scales))
        self._opacities, self._colors = _flat(avatar.opacities), _flat(avatar.colors)
        self._closing = closing
        self._background = _flat(torch.tensor(list(background)))

    @torch.no_grad()
    def meshes(self, params: HeadParameters) -> list[PosedMesh]:
        """The head in T frames; the identity in `params` is ignored."""
        vertices = pose_vertices(self._head, params.replace(identity=params.expression[..., :0]))
        turns = rigid_turn(self.canonical, vertices)
        centres: Sequence[Tensor | None] = [None] * len(vertices)
        if self._avatar.skinning == "released":
            centres = self._avatar.pose(params, self._own_head)[0].unbind()
        return [PosedMesh(*parts) for parts in zip(vertices, turns, centres, strict=True)]

    def gaussians(self, mesh: PosedMesh) -> Posed:
        """The Gaussians of one of `meshes`; the work is queued, not waited for."""
        from uika.avatar.rig import Posed

        if mesh.centres is None:
            return self.rig.pose(mesh.vertices, mesh.turn)
        return Posed(_flat(mesh.centres), *self._still)

    def project(self, mesh: PosedMesh, camera: Camera) -> ProjectedFrame:
        """Begin with one frame: queue its Gaussians and their projection; nothing is waited for."""
        from drjit_splat.constants import T_CLOSING
        from drjit_splat.frames import project_frame

        posed = self.gaussians(mesh)
        view, intrinsics = _flat(camera.viewmat), _flat(camera.K)
        closing = T_CLOSING if self._closing is None else self._closing
        size = camera.width, camera.height
        return project_frame(*posed, self._opacities, self._colors, view, intrinsics, *size, closing)

    def blend(self, projected: ProjectedFrame, last: Frame | None = None) -> Frame:
        """Wait for a frame's projection and queue the rest; quicker with the `last` frame of the film."""
        return projected.blend(self._background, last)


def film(
    avatar: Avatar,
    motion: Motion,
    cameras: Camera | None = None,
    head: HeadModel | None = None,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    size: int = 512,
    closing: float | None = None,
    level: Level = "auto",
    frame: Framing = "bust",
    progress: bool = False,
) -> Iterator[NDArray[np.uint8]]:
    """Render a motion frame by frame as bytes; what `frames` renders, without alpha and gradients.

    Each frame is posed and projected while the one before it is blended, and blended while that one is in the caller's
    hands.

    Args:
        avatar: the avatar.
        motion: T frames.
        cameras: one camera for all frames or T of them; None frames the head and follows the motion's camera path.
        head: the head model; None loads the one that `uika.head.load_head` finds.
        background: sRGB in [0,1].
        size: side of the picture in pixels when `cameras` is None.
        closing: transmittance at which a pixel is closed; None is one grey level at most, 0 leaves nothing out.
        level: `half` draws half as many, larger Gaussians; `auto` does so where they are smaller than a pixel.
        frame: what is framed then, as in `neutral_camera`.
        progress: whether to show a progress bar on stderr.

    Yields:
        [H,W,3] sRGB, rounded.

    Raises:
        AvatarError: the head model is not the avatar's.
        RuntimeError: no LLVM library was found for Dr.Jit; the message says what to install.
    """
    model = load_head() if head is None else head
    avatar.check_head(model)
    path = motion_cameras(avatar, motion, size, frame) if cameras is None else cameras
    renderer = FrameRenderer(at_level(avatar, level, path[0]), model, background, closing)
    params = motion.parameters(avatar.identity)
    last: Frame | None = None
    for index in counted(range(len(motion)), progress, len(motion), "frames"):
        place = index % _BLOCK
        if place == 0:
            meshes = renderer.meshes(params[index : index + _BLOCK])
        projected = renderer.project(meshes[place], path[index])
        done = None if last is None else last.numpy()
        last = renderer.blend(projected, last)
        if done is not None:
            yield done
    if last is not None:
        yield last.numpy()


def _personal(head: HeadModel, identity: Tensor, canonical: Tensor) -> HeadModel:
    """The head with one identity built in, and none to choose."""
    neutral = HeadParameters.zeros(head).replace(identity=identity)
    return replace(
        head,
        template=canonical,
        joints=rest_joints(head, neutral),
        identity_basis=head.identity_basis[:0],
        joint_identity=head.joint_identity[:0],
    )


def _flat(values: Tensor) -> Any:
    from drjit.llvm import Float

    return Float(values.float().contiguous().flatten().numpy())
