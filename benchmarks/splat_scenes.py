"""Scenes for timing: a head-sized shell of flat Gaussians, the same with a heavy tail, and a reconstructed avatar."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from drjit_splat import rasterization
from uika.assets import PORTRAIT

NAMES = ("30k", "130k", "500k", "avatar", "heavy")
QUICK = "3k"  # a scene to try a script with


@dataclass(frozen=True)
class Scene:
    """One camera and its splats; all float32, activated, ready for `drjit_splat.rasterization`."""

    means: Tensor  # [N, 3] metres
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] metres
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    viewmats: Tensor  # [1, 4, 4]
    Ks: Tensor  # [1, 3, 3]
    size: int

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The tensor arguments in the rasterizer's order."""
        return self.means, self.quats, self.scales, self.opacities, self.colors, self.viewmats, self.Ks


def _frames_to_quats(tangent: Tensor, bitangent: Tensor, normal: Tensor) -> Tensor:
    """Quaternions [N, 4] of the rotations with these columns, through the largest of the four candidates."""
    m = torch.stack([tangent, bitangent, normal], dim=-1)
    d = m.diagonal(dim1=-2, dim2=-1)
    trace = d.sum(-1)
    squares = torch.stack([1 + trace, *(1 + 2 * d[:, i] - trace for i in range(3))], -1)
    off = {(i, j): (m[:, i, j], m[:, j, i]) for i, j in ((2, 1), (0, 2), (1, 0))}
    wx, wy, wz = (a - b for a, b in off.values())
    yz, xz, xy = (a + b for a, b in off.values())
    rows = torch.stack(
        [
            torch.stack([squares[:, 0], wx, wy, wz], -1),
            torch.stack([wx, squares[:, 1], xy, xz], -1),
            torch.stack([wy, xy, squares[:, 2], yz], -1),
            torch.stack([wz, xz, yz, squares[:, 3]], -1),
        ],
        dim=1,
    )
    best = squares.argmax(-1)
    return torch.nn.functional.normalize(rows[torch.arange(len(rows)), best], dim=-1)


def head_scene(count: int, size: int, seed: int = 0) -> Scene:
    """`count` splats on a 0.18 x 0.24 x 0.20 m ellipsoid filling 70 % of a `size`^2 image from 1 m away.

    Splats lie uniformly over the surface within a millimetre, are flat (thickness 1/5) and about 1.25 pixels wide
    (log-normal, 0.35); 60 % are nearly opaque.
    """
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    radii = torch.tensor([0.09, 0.12, 0.10], dtype=torch.float64)
    directions = torch.nn.functional.normalize(normal(4 * count, 3), dim=-1)
    # Mapping a sphere to the ellipsoid stretches area by |d / radii|: thin the directions out accordingly.
    stretch = (directions / radii).norm(dim=-1) * radii.min()
    directions = directions[uniform(4 * count) < stretch][:count]
    if len(directions) < count:
        raise ValueError(f"count {count} left only {len(directions)} directions after thinning")
    normals = torch.nn.functional.normalize(directions / radii, dim=-1)
    means = directions * radii + normals * normal(count, 1) * 8e-4 + normal(count, 3) * 3e-4

    helper = torch.where(normals[:, 2:].abs() < 0.9, torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0])).double()
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=-1)
    second = torch.linalg.cross(normals, first)
    angle = 2 * math.pi * uniform(count, 1)
    tangent = angle.cos() * first + angle.sin() * second
    quats = _frames_to_quats(tangent, torch.linalg.cross(normals, tangent), normals)

    focal = 0.7 * size / 0.24
    wide = (normal(count, 2) * 0.35 + math.log(1.25)).exp() / focal
    scales = torch.cat([wide, 0.2 * wide.prod(-1, keepdim=True).sqrt()], -1)
    opacities = torch.where(uniform(count) < 0.6, 0.7 + 0.29 * uniform(count), 0.1 + 0.6 * uniform(count))
    waves = torch.sin(means * torch.tensor([30.0, 25.0, 20.0]) + torch.tensor([0.0, 1.0, 2.0]))
    colors = (0.5 + 0.3 * waves + 0.12 * normal(count, 3)).clamp(0.02, 0.98)

    yaw, pitch = math.radians(10), math.radians(5)
    forward = torch.tensor(
        [math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)], dtype=torch.float64
    )
    right = torch.nn.functional.normalize(torch.tensor([forward[2], 0.0, -forward[0]], dtype=torch.float64), dim=0)
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    view[:3, 3] = view[:3, :3] @ forward
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    arrays = (means, quats, scales, opacities, colors, view[None], K[None])
    return Scene(*(a.to(torch.float32).contiguous() for a in arrays), size=size)


def heavy_scene(count: int, size: int, seed: int = 0, share: float = 0.02, factor: float = 30.0) -> Scene:
    """`head_scene` with a `share` of the splats `factor` times larger."""
    scene = head_scene(count, size, seed)
    chosen = torch.rand(count, generator=torch.Generator().manual_seed(seed + 1)) < share
    return replace(scene, scales=torch.where(chosen[:, None], factor * scene.scales, scene.scales))


def avatar_scene(size: int) -> Scene:
    """The avatar of the bundled portrait in its own expression, seen from the front; takes a minute."""
    from uika import load_head, neutral_camera, reconstruct
    from uika.head import HeadParameters

    head = load_head()
    avatar = reconstruct([PORTRAIT], head).avatar
    means, quats, scales = avatar.pose(HeadParameters.zeros(head), head)
    camera = neutral_camera(avatar, size=size)
    arrays = (means, quats, scales, avatar.opacities, avatar.colors, camera.viewmat[None], camera.K[None])
    return Scene(*(a.to(torch.float32).contiguous() for a in arrays), size=size)


def passes(scene: Scene) -> dict[str, Callable[[], object]]:
    """What the benchmarks time: `forward` without gradients, and `both`, with those of all splats."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]
    weight = torch.rand(scene.size, scene.size, scene.colors.shape[1], generator=torch.Generator().manual_seed(1))

    def forward() -> None:
        with torch.no_grad():
            rasterization(*scene.tensors, scene.size, scene.size)

    def both() -> None:
        image = rasterization(*leaves, *scene.tensors[5:], scene.size, scene.size)[0][0]
        torch.autograd.grad(image, leaves, grad_outputs=weight)

    return {"forward": forward, "both": both}


def named_scene(name: str) -> Scene:
    """One of `NAMES`: three sizes of the head, the avatar at 512 x 512, 130k with a heavy tail; or `QUICK`."""
    if name == "avatar":
        return avatar_scene(512)
    if name == "heavy":
        return heavy_scene(130_000, 512)
    count, size = {QUICK: (3_000, 96), "30k": (30_000, 256), "130k": (130_000, 512), "500k": (500_000, 1024)}[name]
    return head_scene(count, size)
