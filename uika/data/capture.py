"""Captures on disk: folders with a `transforms.json`, as VHAP and GaussianAvatars export NeRSemble, VFHQ and others."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uika.data.decoding import Frame, build_sample, read_arrays, shared_arrays
from uika.data.sample import DataError, Sample

DESCRIPTION = "transforms.json"
# What stands in the place of it where VHAP has joined several sequences of a person; the parts have no frame in common.
PARTS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
_UNION = "UNION"  # starts the name of such a folder; its person comes next
_REQUIRED = ("file_path", "fl_x", "fl_y", "cx", "cy", "transform_matrix")
_FILES = ("file_path", "fg_mask_path", "flame_param_path", "uv_path", "depth_path")
_IGNORED = ("dynamic_offset",)  # arrays of a frame that nothing here reads


@dataclass(frozen=True, eq=False)
class Capture:
    """One sequence of one person; images are read when they are asked for."""

    folder: Path
    frames: tuple[Frame, ...]
    skipped: tuple[str, ...]  # why frames were left out, one sentence each
    canonical: dict[str, Any]  # `shape` and `static_offset`, where all frames share them
    notes: tuple[str, ...] = ()  # what else of the capture is not used, one sentence each

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
        return build_sample(frame, contents, self.canonical, str(self.folder), _name(self.folder))

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


def is_capture(folder: Path) -> bool:
    """Whether a folder holds a capture's description."""
    return (folder / DESCRIPTION).is_file() or (folder / PARTS[0]).is_file()


def open_capture(path: str | Path, strict: bool = False) -> Capture:
    """Read the description of a capture and check its frames.

    Args:
        path: the folder that holds `transforms.json`, or the parts of it that VHAP writes where it joins sequences,
            whose frames lie in folders beside this one.
        strict: whether a frame that cannot be used is an error rather than left out.

    Raises:
        DataError: no description, or a damaged one, or no usable frame; with `strict` also the first bad frame.
    """
    folder = Path(path)
    found = [folder / DESCRIPTION]
    joined = not found[0].is_file() and (folder / PARTS[0]).is_file()
    if joined:
        found = [folder / part for part in PARTS if (folder / part).is_file()]
    files = _Files(folder, joined)
    frames: list[Frame] = []
    skipped: list[str] = []
    for description in found:
        for number, entry in enumerate(_entries(description)):
            try:
                frames.append(_frame(files, entry, description, number))
            except DataError as error:
                if strict:
                    raise
                skipped.append(str(error))
    if not frames:
        first = f"; the first: {skipped[0]}" if skipped else ""
        raise DataError(f"{found[0]}: has no usable frame{first}")
    canonical, notes = _shared(folder)
    return Capture(folder, tuple(frames), tuple(skipped), canonical, (*notes, *_unread(folder, frames[0])))


def _entries(description: Path) -> list[Any]:
    try:
        content = json.loads(description.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{description}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{description}: is not complete JSON ({error})") from error
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list):
        raise DataError(f"{description}: lacks the list 'frames'")
    return entries


def _shared(folder: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays that all frames share, and what is left out of them."""
    path = folder / "canonical_flame_param.npz"
    if not path.is_file():
        return {}, []
    return shared_arrays(read_arrays(path.read_bytes(), str(path)), str(path))


def _unread(folder: Path, frame: Frame) -> list[str]:
    """What the first frame's parameters hold that nothing here reads."""
    name = frame.files.get("flame_param_path")
    if name is None:
        return []
    try:
        arrays = read_arrays((folder / name).read_bytes(), str(folder / name))
    except (DataError, OSError):
        return []  # said when the frame is read
    return [f"{folder}: '{array}' of its frames is not used" for array in _IGNORED if array in arrays]


def _name(folder: Path) -> str:
    """The capture's name, which starts with the person's."""
    first, _, rest = folder.name.partition("_")
    return rest if first.startswith(_UNION) and rest else folder.name


class _Files:
    """Which files the entries of a capture may name; every folder is listed once, however many frames there are."""

    def __init__(self, folder: Path, joined: bool) -> None:
        self.folder, self._joined = folder, joined
        self._root = folder.resolve()
        self._listed: dict[str, tuple[bool, frozenset[str]]] = {}

    def inside(self, value: str) -> tuple[bool, bool]:
        """Whether a path leads into the capture, and whether a file lies there."""
        place, _, name = value.replace(os.sep, "/").rpartition("/")
        if place not in self._listed:
            self._listed[place] = self._list(place)
        inside, names = self._listed[place]
        if name in ("", ".", ".."):
            return inside and name == "", False
        if name in names:
            return True, True
        # A link, whose target decides, or nothing.
        target = self.folder / value
        return inside and self._allowed(target.resolve()), inside and target.is_file()

    def _list(self, place: str) -> tuple[bool, frozenset[str]]:
        folder = self.folder / place
        if not self._allowed(folder.resolve()):
            return False, frozenset()
        try:
            with os.scandir(folder) as entries:
                return True, frozenset(entry.name for entry in entries if entry.is_file(follow_symlinks=False))
        except FileNotFoundError:
            return True, frozenset()

    def _allowed(self, target: Path) -> bool:
        if target.is_relative_to(self._root):
            return True
        # Joined sequences lie in folders beside this one.
        return self._joined and target != self._root.parent and target.is_relative_to(self._root.parent)


def _frame(known: _Files, entry: Any, description: Path, number: int) -> Frame:
    where = f"{description}: frame {number}"
    if not isinstance(entry, dict) or (missing := [name for name in _REQUIRED if name not in entry]):
        raise DataError(f"{where} lacks {', '.join(missing) if isinstance(entry, dict) else 'its entries'}")
    files = {}
    for name in _FILES:
        if (value := entry.get(name)) is None:
            continue
        try:
            if not isinstance(value, str):
                raise ValueError("not text")
            inside, found = known.inside(value)
        except (OSError, ValueError) as error:  # too long, or with characters that no path has
            raise DataError(f"{where}: {name} is no path ({error})") from error
        if not inside:
            raise DataError(f"{where}: {name} '{value}' leads out of the folder")
        if not found:
            raise DataError(f"{known.folder / value}: is missing, but frame {number} needs it")
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
