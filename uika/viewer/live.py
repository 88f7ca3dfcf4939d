"""An avatar as the buffer that the browser's splat node takes."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.frame_renderer import FrameRenderer
from uika.head import Camera, HeadModel, HeadParameters, pose_gaussians, shaped_vertices

if TYPE_CHECKING:
    from uika.avatar.rig import Posed

UNITS = 100.0  # of the page for a metre: covariances in square metres would be too small for half precision
Paint = Literal["photo", "UV"]


class LiveSplats:
    """Poses an avatar and packs it: 32 bytes for each Gaussian, centre, covariance and colour."""

    def __init__(self, avatar: Avatar, head: HeadModel) -> None:
        """Prepare; the first pose takes longer because kernels are compiled.

        Raises:
            AvatarError: the head model is not the avatar's.
            RuntimeError: no LLVM library was found for Dr.Jit; the message says what to install.
        """
        self._original, self._head = avatar, head
        self.avatar = avatar
        self._buffer: NDArray[np.uint32] = np.zeros((len(avatar), 8), np.uint32)
        self.paint("photo")

    def paint(self, colors: Paint) -> None:
        """Choose between the avatar's own colours and its place in the atlas (u red, v green)."""
        shown = self.avatar.colors
        if colors == "UV":
            corners = self._head.uvs[self._head.uv_faces[self.avatar.triangle]]
            uv = (corners * self.avatar.barycentric[..., None]).sum(1)
            uv[:, 0] -= self.avatar.on_bust.to(uv.dtype)  # the bust's tile begins at 1
            shown = torch.cat((uv, torch.zeros(len(uv), 1)), -1)
        self._shown = shown
        rgba = torch.cat((shown, self.avatar.opacities[:, None]), -1).clamp(0, 1)
        self._renderer = FrameRenderer(self.painted(), self._head)
        self._buffer[:, 7:8] = (rgba * 255).round().byte().numpy().view(np.uint32)

    def painted(self) -> Avatar:
        """The avatar in the colours that are shown."""
        return dataclasses.replace(self.avatar, colors=self._shown)

    def reshape(self, identity: Tensor) -> None:
        """Give the avatar another identity [K]; its Gaussians follow the surface."""
        first = self._original
        old = first.canonical_vertices(self._head)
        rest = HeadParameters.zeros(self._head).replace(identity=identity)
        new = shaped_vertices(self._head, rest, first.static_offset)
        binding = (self._head.faces, first.triangle, first.barycentric)
        means, quats, scales = pose_gaussians(first.means, first.quats, first.scales, old, new, *binding)
        self.avatar = dataclasses.replace(first, identity=identity, means=means, quats=quats, scales=scales)
        self._renderer = FrameRenderer(self.painted(), self._head)

    def pose(self, params: HeadParameters) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
        """The buffer [N,8] and the mesh [V,3] of one pose, in the page's units."""
        (mesh,) = self._renderer.meshes(_many(params))
        posed = self._renderer.gaussians(mesh)
        count = len(self.avatar)
        covariances = _covariances(posed, count).numpy().reshape(count, 6)
        np.multiply(posed.means.numpy().reshape(count, 3), np.float32(UNITS), out=self._buffer[:, :3].view(np.float32))
        self._buffer[:, 4:7] = covariances.view(np.uint32)
        return self._buffer.copy(), mesh.vertices.numpy() * np.float32(UNITS)

    def draw(self, params: HeadParameters, camera: Camera) -> NDArray[np.uint8]:
        """The picture [H,W,3] of one pose, by the rasterizer, in the colours that are shown."""
        (mesh,) = self._renderer.meshes(_many(params))
        return self._renderer.blend(self._renderer.project(mesh, camera)).numpy()


def _many(params: HeadParameters) -> HeadParameters:
    """The same with a batch of one."""
    return dataclasses.replace(params, **{f.name: getattr(params, f.name)[None] for f in dataclasses.fields(params)})


def _covariances(posed: Posed, count: int) -> Any:
    """Upper triangles [N * 6] (xx xy xz yy yz zz) of the covariances in the page's units, half precision."""
    from drjit.llvm import Float, Float16, UInt32

    i = dr.arange(UInt32, count)
    a, b, c = (UNITS * dr.gather(Float, posed.scales, 3 * i + k) for k in range(3))
    quat = [dr.gather(Float, posed.quats, 4 * i + k) for k in range(4)]
    shrink = dr.rsqrt(sum(q * q for q in quat))
    w, x, y, z = (q * shrink for q in quat)
    rows = (
        (a * (1 - 2 * (y * y + z * z)), b * 2 * (x * y - w * z), c * 2 * (x * z + w * y)),
        (a * 2 * (x * y + w * z), b * (1 - 2 * (x * x + z * z)), c * 2 * (y * z - w * x)),
        (a * 2 * (x * z - w * y), b * 2 * (y * z + w * x), c * (1 - 2 * (x * x + y * y))),
    )
    result = dr.empty(Float16, 6 * count)
    for place, (one, other) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        covariance = sum(p * q for p, q in zip(rows[one], rows[other], strict=True))
        dr.scatter(result, Float16(covariance), 6 * i + place, mode=dr.ReduceMode.Permute)
    return result
