"""Pinhole cameras in OpenCV axes (x right, y down, z forward)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole camera or a batch of them; pixel centres lie at +0.5."""

    viewmat: Tensor  # [...,4,4] world to camera, metres
    K: Tensor  # [...,3,3] pixels
    width: int
    height: int

    def __post_init__(self) -> None:
        """Check shapes and size.

        Raises:
            ValueError: a matrix has the wrong shape or the image is empty.
        """
        for name, matrix, size in (("viewmat", self.viewmat, 4), ("K", self.K, 3)):
            if tuple(matrix.shape[-2:]) != (size, size):
                raise ValueError(f"camera '{name}' has shape {tuple(matrix.shape)}; it must end in {size}x{size}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera image of {self.width}x{self.height} pixels is empty")

    def __getitem__(self, index: Any) -> Camera:
        """Index the first batch dimension; an unbatched matrix is kept whole."""
        viewmat = self.viewmat[index] if self.viewmat.ndim > 2 else self.viewmat
        return Camera(viewmat, self.K[index] if self.K.ndim > 2 else self.K, self.width, self.height)

    @property
    def position(self) -> Tensor:
        """Camera centres [...,3] in world space."""
        rotation, shift = self.viewmat[..., :3, :3], self.viewmat[..., :3, 3:]
        return -(rotation.mT @ shift)[..., 0]

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Camera:
        """A copy in another type or on another device."""
        viewmat, K = (m.to(device=device, dtype=dtype) for m in (self.viewmat, self.K))
        return Camera(viewmat, K, self.width, self.height)

    def resized(self, width: int, height: int) -> Camera:
        """The same view sampled with another number of pixels."""
        factor = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.viewmat, self.K * factor, width, height)

    @staticmethod
    def stack(cameras: Sequence[Camera]) -> Camera:
        """Join cameras of one image size along a new first batch dimension.

        Raises:
            ValueError: there is no camera, or the image sizes differ.
        """
        if len({(camera.width, camera.height) for camera in cameras}) != 1:
            raise ValueError("Camera.stack needs one or more cameras of the same image size")
        viewmat, K = (torch.stack([getattr(camera, name) for camera in cameras]) for name in ("viewmat", "K"))
        return Camera(viewmat, K, cameras[0].width, cameras[0].height)


def project(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project world points [...,N,3] (metres) to pixels [...,N,2] and camera depth [...,N] (metres).

    Points at or behind the camera get a finite pixel that means nothing: test the depth.
    """
    viewmat, K = camera.viewmat.to(points.dtype), camera.K.to(points.dtype)
    local = points @ viewmat[..., :3, :3].mT + viewmat[..., None, :3, 3]
    image = local @ K.mT
    z = local[..., 2]
    divisor = torch.where(z.abs() < 1e-8, torch.full_like(z, 1e-8), z)
    return image[..., :2] / divisor[..., None], z


def look_at(
    yaw: float = 0.0,
    pitch: float = 0.0,
    distance: float = 1.0,
    target: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    *,
    fov_y: float | None = None,
    focal: float | None = None,
    size: int | tuple[int, int] = 512,
) -> Camera:
    """A camera on a sphere around `target`, upright, looking at it.

    Args:
        yaw: degrees; positive moves the camera to the subject's left (+X).
        pitch: degrees in (-90, 90); positive moves the camera up.
        distance: metres from the target.
        target: [3] metres.
        fov_y: vertical field of view in degrees; 20 when neither this nor `focal` is given.
        focal: focal length in pixels, instead of `fov_y`.
        size: image side in pixels, or (width, height).

    Raises:
        ValueError: both `fov_y` and `focal` are given, or a value is out of range.
    """
    if fov_y is not None and focal is not None:
        raise ValueError("look_at takes fov_y or focal, not both")
    if not abs(pitch) < 90 or not distance > 0:
        raise ValueError(f"look_at needs |pitch| < 90 degrees and distance > 0, got {pitch} and {distance}")
    width, height = (size, size) if isinstance(size, int) else size
    angle = 20.0 if fov_y is None else fov_y
    f = height / 2 / math.tan(math.radians(angle) / 2) if focal is None else focal
    a, b = math.radians(yaw), math.radians(pitch)
    backward = torch.tensor([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)], dtype=torch.float64)
    right = torch.tensor([math.cos(a), 0.0, -math.sin(a)], dtype=torch.float64)
    down = torch.linalg.cross(right, backward)
    rotation = torch.stack((right, down, -backward))
    position = torch.as_tensor(target, dtype=torch.float64) + distance * backward
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ position
    K = torch.tensor([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, width, height)


def orbit(
    count: int,
    yaw_amplitude: float = 35.0,
    pitch_amplitude: float = 10.0,
    distance: float = 1.0,
    target: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    *,
    fov_y: float | None = None,
    focal: float | None = None,
    size: int | tuple[int, int] = 512,
) -> Camera:
    """A closed elliptic path of `count` cameras around the front view, amplitudes in degrees; see `look_at`."""
    if count < 1:
        raise ValueError(f"orbit needs at least one camera, got {count}")
    phases = [2 * math.pi * index / count for index in range(count)]
    return Camera.stack(
        [
            look_at(
                yaw_amplitude * math.sin(phase),
                pitch_amplitude * math.cos(phase),
                distance,
                target,
                fov_y=fov_y,
                focal=focal,
                size=size,
            )
            for phase in phases
        ]
    )


def ellipse(
    count: int,
    radii: tuple[float, float] = (0.35, 0.8),
    distance: float = 0.7,
    *,
    focal: float = 1000.0,
    size: int = 512,
) -> Camera:
    """The released program's path of `count` cameras: an ellipse in front of the head, each looking at the origin.

    Args:
        count: number of cameras, from the top towards the subject's left.
        radii: of the ellipse, upwards and sideways, metres.
        distance: of its plane from the origin, metres.
        focal: focal length in pixels.
        size: image side in pixels.

    Raises:
        ValueError: `count` is below 1 or `distance` is not positive.
    """
    if count < 1 or not distance > 0:
        raise ValueError(f"ellipse needs at least one camera and distance > 0, got {count} and {distance}")
    phases = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    height, side = radii[0] * phases.cos(), radii[1] * phases.sin()
    position = torch.stack((side, height, torch.full_like(side, distance)), dim=-1)
    forward = torch.nn.functional.normalize(-position, dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(forward)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    viewmat = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    viewmat[:, :3, :3] = rotation
    viewmat[:, :3, 3:] = -rotation @ position[..., None]
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]).repeat(count, 1, 1)
    return Camera(viewmat.float(), K, size, size)
