"""Photos with known cameras from disk, whatever program wrote them down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MAX_PIXELS = 100_000_000  # of one picture
ROTATION_ERROR = 1e-3  # largest entry of R R^T - 1


@dataclass(frozen=True, eq=False)
class Photo:
    """One picture and the camera that took it, OpenCV axes, pixel centres at +0.5."""

    path: Path
    viewmat: Tensor  # [4,4] float32, world to camera
    K: Tensor  # [3,3] pixels
    width: int
    height: int

    def pixels(self, shrink: int = 1) -> Tensor:
        """The picture [h,w,4] (colours, then opacity) in [0,1]; its sides are divided by `shrink`, rounded down.

        Raises:
            ValueError: the file is missing, no picture, or of another size than its camera says.
        """
        return torch.from_numpy(_read(self.path, (self.width, self.height), shrink))

    def shrunk(self, shrink: int) -> Photo:
        """The same camera for a picture whose sides are divided by `shrink`, rounded down."""
        width, height = self.width // shrink, self.height // shrink
        scale = torch.tensor([width / self.width, height / self.height, 1.0])
        return replace(self, K=scale[:, None] * self.K, width=width, height=height)


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos of one scene, sorted by name, and the points that were triangulated from them, if there are any."""

    photos: tuple[Photo, ...]
    held_out: tuple[Photo, ...]
    points: Tensor | None = None  # [P,3] world
    colors: Tensor | None = None  # [P,3] in [0,1]

    @property
    def centre(self) -> Tensor:
        """The point [3] that the cameras' axes come nearest to."""
        positions, forward = _axes(self.photos)
        across = torch.eye(3) - forward[:, :, None] * forward[:, None]
        moment = (across @ positions[..., None]).sum(0)
        # Parallel axes meet nowhere: what they leave open is decided by the cameras' mean place.
        pull = 1e-3 * len(self.photos)
        return torch.linalg.solve(across.sum(0) + pull * torch.eye(3), moment[:, 0] + pull * positions.mean(0))

    @property
    def extent(self) -> float:
        """Largest distance of a camera from the mean camera, times 1.1: the scale of learning rates, as in 3DGS."""
        positions, _ = _axes(self.photos)
        return max(1.1 * float((positions - positions.mean(0)).norm(dim=-1).max()), 1e-6)


def is_there(path: Path) -> bool:
    """Whether a path from a data set is that of a file; names that no file can have are none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def rigid(viewmat: NDArray[np.float64], source: str) -> Tensor:
    """A world-to-camera matrix [4,4] as float32.

    Raises:
        ValueError: it is none; the message begins with `source`.
    """
    turn = viewmat[:3, :3]
    sound = np.isfinite(viewmat).all() and np.abs(turn @ turn.T - np.eye(3)).max() < ROTATION_ERROR
    sound = sound and np.abs(viewmat[3] - (0, 0, 0, 1)).max() < ROTATION_ERROR
    if not sound or np.linalg.det(turn) < 0:
        raise ValueError(f"{source}: its pose is no rotation with a translation")
    return torch.from_numpy(viewmat.astype(np.float32))


def _axes(photos: Sequence[Photo]) -> tuple[Tensor, Tensor]:
    """Positions and viewing directions [N,3] of cameras."""
    turns = torch.stack([photo.viewmat[:3, :3] for photo in photos])
    shifts = torch.stack([photo.viewmat[:3, 3] for photo in photos])
    return -(turns.mT @ shifts[..., None])[..., 0], turns[:, 2]


def _read(path: Path, size: tuple[int, int], shrink: int) -> NDArray[np.float32]:
    try:
        from PIL import Image, UnidentifiedImageError
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("reading photos needs pillow; run: pip install pillow") from error
    try:
        with Image.open(path) as image:
            if image.size != size:
                raise ValueError(
                    f"{path}: is {image.size[0]}x{image.size[1]} pixels; its camera says {size[0]}x{size[1]}"
                )
            if size[0] * size[1] > MAX_PIXELS:
                raise ValueError(f"{path}: has more than {MAX_PIXELS:,} pixels")
            whole = image.convert("RGBA")
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: cannot be read as a picture ({error})") from error
    small = max(1, size[0] // shrink), max(1, size[1] // shrink)
    if small != size:
        whole = whole.resize(small, Image.Resampling.BOX)
    return np.asarray(whole).astype(np.float32) / np.float32(255)
