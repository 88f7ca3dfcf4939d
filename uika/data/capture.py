"""Captures on disk: folders with a `transforms.json`, as VHAP and GaussianAvatars export NeRSemble, VFHQ and others."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uika.data.decoding import Frame, build_sample, read_arrays
from uika.data.sample import DataError, Sample

DESCRIPTION = "transforms.json"
_REQUIRED = ("file_path", "fl_x", "fl_y", "cx", "cy", "transform_matrix")
_FILES = ("file_path", "fg_mask_path", "flame_param_path", "uv_path", "depth_path")


@dataclass(frozen=True, eq=False)
class Capture:
    """One sequence of one person; images are read when they are asked for."""

    folder: Path
    frames: tuple[Frame, ...]
    skipped: tuple[str, ...]  # why frames were left out, one sentence each
    canonical: dict[str, Any]  # arrays that all frames share, such as `shape`

    def __len__(self) -> int:
        """The number of usable frames."""
        return len(self.frames)

    def sample(self, index: int) -> Sample:
        """Read one frame.

        Raises:
            DataError: a file of the frame cannot be used; the message names it.
        """
        frame = self.frames[index]
        contents = {}
        for kind, path in frame.files.items():
            try:
                contents[kind] = (self.folder / path).read_bytes()
            except OSError as error:
                raise DataError(f"{self.folder / path}: cannot be read ({error.strerror})") from error
        return build_sample(frame, contents, self.canonical, str(self.folder), self.folder.name)

    def samples(self, strict: bool = False) -> Iterator[Sample]:
        """All frames in order; those that cannot be read are left out unless `strict`.

        Raises:
            DataError: `strict`, and a file cannot be used.
        """
        for index in range(len(self)):
            try:
                yield self.sample(index)
            except DataError:
                if strict:
                    raise


def open_capture(path: str | Path, strict: bool = False) -> Capture:
    """Read the description of a capture and check its frames.

    Args:
        path: the folder that holds `transforms.json`.
        strict: whether a frame that cannot be used is an error rather than left out.

    Raises:
        DataError: no description, or a damaged one, or no usable frame; with `strict` also the first bad frame.
    """
    folder = Path(path)
    description = folder / DESCRIPTION
    try:
        content = json.loads(description.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{description}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{description}: is not complete JSON ({error})") from error
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list):
        raise DataError(f"{description}: lacks the list 'frames'")
    frames, skipped = [], []
    for number, entry in enumerate(entries):
        try:
            frames.append(_frame(folder, entry, number))
        except DataError as error:
            if strict:
                raise
            skipped.append(str(error))
    if not frames:
        first = f"; the first: {skipped[0]}" if skipped else ""
        raise DataError(f"{description}: has no usable frame{first}")
    shared = folder / "canonical_flame_param.npz"
    canonical = read_arrays(shared.read_bytes(), str(shared)) if shared.is_file() else {}
    return Capture(folder, tuple(frames), tuple(skipped), canonical)


def _frame(folder: Path, entry: Any, number: int) -> Frame:
    where = f"{folder / DESCRIPTION}: frame {number}"
    if not isinstance(entry, dict) or (missing := [name for name in _REQUIRED if name not in entry]):
        raise DataError(f"{where} lacks {', '.join(missing) if isinstance(entry, dict) else 'its entries'}")
    root = folder.resolve()
    files = {}
    for name in _FILES:
        if (value := entry.get(name)) is None:
            continue
        try:
            inside = isinstance(value, str) and (root / value).resolve().is_relative_to(root)
            found = inside and (folder / value).is_file()
        except (OSError, ValueError) as error:  # too long, or with characters that no path has
            raise DataError(f"{where}: {name} is no path ({error})") from error
        if not inside:
            raise DataError(f"{where}: {name} '{value}' leads out of the folder")
        if not found:
            raise DataError(f"{folder / value}: is missing, but frame {number} needs it")
        files[name] = value
    if "file_path" not in files:
        raise DataError(f"{where}: file_path names no image")
    return parse_frame(entry, files, where, number)


def parse_frame(entry: dict[str, Any], files: dict[str, str], where: str, number: int) -> Frame:
    """Check the camera of a frame's entry.

    Raises:
        DataError: a number is missing, not finite or out of range; the message starts with `where`.
    """
    try:
        lens = tuple(float(entry[name]) for name in ("fl_x", "fl_y", "cx", "cy"))
        matrix = tuple(tuple(float(value) for value in row) for row in entry["transform_matrix"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: the camera is not made of numbers ({error})") from error
    if len(matrix) != 4 or any(len(row) != 4 for row in matrix):
        raise DataError(f"{where}: transform_matrix must be 4x4")
    if not all(map(math.isfinite, (*lens, *(value for row in matrix for value in row)))):
        raise DataError(f"{where}: the camera holds values that are not finite")
    if min(lens[:2]) <= 0:
        raise DataError(f"{where}: fl_x and fl_y must be positive")
    timestep = entry.get("timestep_index", number)
    if not isinstance(timestep, int):
        raise DataError(f"{where}: timestep_index must be a whole number")
    return Frame(timestep, str(entry.get("camera_id", entry.get("camera_index", "0"))), lens, matrix, files)
