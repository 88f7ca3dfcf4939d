"""FLAME parameter files as VHAP and GaussianAvatars keep them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.io.files import check_output, replacing
from uika.io.npz import ArraysError, read_npz
from uika.motion.motion import Motion, MotionError

FPS = 25.0  # the files do not say
_SHAPES = 300
# Our field -> array of the file.
_NAMES = {
    "expression": "expr",
    "rotation": "rotation",
    "neck": "neck_pose",
    "jaw": "jaw_pose",
    "eyes": "eyes_pose",
    "translation": "translation",
}
_SIZES = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}


def is_flame_params(path: Path) -> bool:
    """Whether an `.npz` file has the array `expr`, which tells FLAME parameters from our own motions."""
    try:
        with path.open("rb") as handle, zipfile.ZipFile(handle) as archive:
            return "expr.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def read_flame_params(path: str | Path, fps: float = FPS) -> Motion:
    """FLAME parameters as a motion whose expressions are FLAME's; `shape`, offsets and unknown arrays are left out.

    Args:
        path: one `.npz` with `expr` [T,E] and poses, or a folder with one such file for each frame, in the order of
            their names; the files may lie in a subfolder `flame_param`.
        fps: frames per second.

    Raises:
        MotionError: a file is missing or damaged, or its arrays have different numbers of frames.
    """
    place = Path(path)
    files = [place]
    if place.is_dir():
        folder = place / "flame_param" if (place / "flame_param").is_dir() else place
        files = sorted(file for file in folder.glob("*.npz") if not file.name.startswith("canonical"))
        if not files:
            raise MotionError(f"{place}: holds no FLAME parameter files (.npz)")
    frames = [_arrays(file) for file in files]
    try:
        return Motion(fps=fps, **{name: torch.cat([frame[name] for frame in frames]) for name in _NAMES})
    except (MotionError, RuntimeError) as error:
        raise MotionError(f"{place}: {error}") from error


def write_flame_params(motion: Motion, path: str | Path, shape: Tensor | None = None) -> None:
    """Write a motion of a FLAME head as one parameter file.

    Args:
        motion: its expressions must be FLAME's.
        path: `.npz` file.
        shape: [K] identity; zeros (300) if None.
    """
    arrays = {other: getattr(motion, name).numpy() for name, other in _NAMES.items()}
    arrays["shape"] = (torch.zeros(_SHAPES) if shape is None else shape).numpy()
    with replacing(check_output(path, ".npz")) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _arrays(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise MotionError(f"{path}: no such motion file")
    try:
        arrays = read_npz(path, _NAMES.values())
    except ArraysError as error:
        raise MotionError(f"{path}: cannot be read as an .npz of plain arrays ({error})") from error
    found = {name: arrays[other] for name, other in _NAMES.items() if other in arrays}
    if "expression" not in found:
        raise MotionError(f"{path}: lacks the array 'expr', so it holds no FLAME parameters")
    for name, array in found.items():
        if not np.issubdtype(array.dtype, np.floating):
            raise MotionError(f"{path}: array '{_NAMES[name]}' must hold real numbers, not {array.dtype}")
    rows = {name: torch.from_numpy(np.atleast_2d(array).astype(np.float32)) for name, array in found.items()}
    count = len(rows["expression"])
    return {name: rows.get(name, torch.zeros(count, _SIZES.get(name, 0))) for name in _NAMES}
