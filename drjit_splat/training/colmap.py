"""COLMAP's tables of cameras, images and points, as text or binary (https://colmap.github.io/format.html)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from .._rotations import quats_to_rotations
from .captures import Capture, Photo, rigid

# Number in binary tables -> name, number of parameters.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")


class _Camera(NamedTuple):
    model: str
    width: int
    height: int
    values: tuple[float, ...]


def colmap_folder(place: Path) -> Path | None:
    """Where a data set's tables lie; None where there are none."""
    for name in _FOLDERS:
        for ending in (".bin", ".txt"):
            if (place / name / f"cameras{ending}").is_file() and (place / name / f"images{ending}").is_file():
                return place / name
    return None


def read_colmap(place: Path, tables: Path) -> Capture:
    """A reconstruction; its pictures lie in `images` beside the tables' folder.

    Raises:
        ValueError: a table cannot be used; the message names it.
    """
    ending = ".bin" if (tables / "cameras.bin").is_file() else ".txt"
    cameras_file, images_file = tables / f"cameras{ending}", tables / f"images{ending}"
    binary = ending == ".bin"
    cameras = dict(_whole(cameras_file, _binary_cameras if binary else _text_cameras))
    photos = []
    for name, camera_id, quat, shift in _whole(images_file, _binary_images if binary else _text_images):
        if camera_id not in cameras:
            raise ValueError(f"{images_file}: image '{name}' has the camera {camera_id}, which {cameras_file} lacks")
        photos.append(_photo(place, images_file, name, cameras[camera_id], quat, shift))
    if not photos:
        raise ValueError(f"{images_file}: holds no image with a pose")
    points_file = tables / f"points3D{ending}"
    rows = list(_whole(points_file, _binary_points if binary else _text_points)) if points_file.is_file() else []
    table = torch.tensor(rows, dtype=torch.float32) if rows else None
    if table is not None and not bool(torch.isfinite(table).all()):
        raise ValueError(f"{points_file}: a point is not finite")
    points, colors = (None, None) if table is None else (table[:, :3].contiguous(), table[:, 3:] / 255)
    return Capture(tuple(photos), (), points, colors)


def _photo(place: Path, table: Path, name: str, camera: _Camera, quat: Any, shift: Any) -> Photo:
    file = place / "images" / name
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError(f"{table}: image '{name}' lies outside the data set")
    if camera.model not in ("SIMPLE_PINHOLE", "PINHOLE"):
        raise ValueError(
            f"{table.with_stem('cameras')}: camera model {camera.model} bends rays; undistort the pictures first "
            "(colmap image_undistorter), only SIMPLE_PINHOLE and PINHOLE are trained"
        )
    fx, fy, cx, cy = camera.values if camera.model == "PINHOLE" else (camera.values[0], *camera.values)
    if not (min(fx, fy) > 0 and np.isfinite(camera.values).all() and 0 < camera.width < 1 << 16 > camera.height > 0):
        raise ValueError(f"{table.with_stem('cameras')}: the camera of '{name}' has impossible numbers {camera}")
    viewmat = np.eye(4)
    norm = float(np.linalg.norm(quat))
    turn = quats_to_rotations(torch.tensor(quat, dtype=torch.float64)[None])[0].numpy()
    viewmat[:3, :3], viewmat[:3, 3] = (turn if norm > 1e-6 else np.nan), shift
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Photo(file, rigid(viewmat, f"{table}: image '{name}'"), K, camera.width, camera.height)


def _whole(path: Path, reader: Any) -> list[Any]:
    """All rows of a table."""
    try:
        return list(reader(path))
    except (OSError, ValueError, KeyError, IndexError, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise ValueError(f"{path}: is no COLMAP table or is cut short ({type(error).__name__}: {error})") from None


class _Bytes:
    """A binary table, read from front to back; a count that the file cannot hold is an error, not memory."""

    def __init__(self, path: Path) -> None:
        self._data, self._at = path.read_bytes(), 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self._data, self._at)
        self._at += struct.calcsize("<" + form)
        return values

    def count(self, least: int) -> int:
        """A number of rows of `least` bytes or more each."""
        (count,) = self.take("Q")
        self.skip(0, count, least)
        return int(count)

    def skip(self, offset: int, count: int, size: int) -> None:
        if count * size > len(self._data) - self._at:
            raise ValueError(f"it says {count:,} rows, more than it holds")
        self._at += offset

    def text(self) -> str:
        end = self._data.index(b"\0", self._at)
        text = self._data[self._at : end].decode("utf-8")
        self._at = end + 1
        return text


def _binary_cameras(path: Path) -> Iterator[tuple[int, _Camera]]:
    data = _Bytes(path)
    for _ in range(data.count(24)):
        number, model, width, height = data.take("iiQQ")
        if model not in _MODELS:
            raise ValueError(f"unknown camera model {model}")
        name, parameters = _MODELS[model]
        yield number, _Camera(name, width, height, data.take(f"{parameters}d"))


def _binary_images(path: Path) -> Iterator[tuple[str, int, tuple[float, ...], tuple[float, ...]]]:
    data = _Bytes(path)
    for _ in range(data.count(64)):
        data.take("i")
        quat, shift, (camera,) = data.take("4d"), data.take("3d"), data.take("i")
        name = data.text()
        (seen,) = data.take("Q")
        data.skip(24 * seen, seen, 24)
        yield name, camera, quat, shift


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    data = _Bytes(path)
    for _ in range(data.count(43)):
        data.take("Q")
        place, color, _ = data.take("3d"), data.take("3B"), data.take("d")
        (track,) = data.take("Q")
        data.skip(8 * track, track, 8)
        yield (*place, *color)


def _lines(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8") as file:
        yield from (line.rstrip("\n") for line in file if not line.startswith("#"))


def _text_cameras(path: Path) -> Iterator[tuple[int, _Camera]]:
    parameters = dict(_MODELS.values())
    for line in filter(str.strip, _lines(path)):
        number, model, width, height, *values = line.split()
        if len(values) != parameters.get(model, len(values)):
            raise ValueError(f"camera model {model} has {parameters[model]} parameters, not {len(values)}")
        yield int(number), _Camera(model, int(width), int(height), tuple(map(float, values)))


def _text_images(path: Path) -> Iterator[tuple[str, int, tuple[float, ...], tuple[float, ...]]]:
    lines = _lines(path)
    for line in lines:
        if not line.strip():
            continue
        _, *numbers, camera, name = line.split(maxsplit=9)
        values = tuple(map(float, numbers))
        if len(values) != 7:
            raise ValueError(f"an image has {len(values)} numbers for its pose, not 7")
        next(lines, None)  # the points seen in it
        yield name.strip(), int(camera), values[:4], values[4:7]


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line in filter(str.strip, _lines(path)):
        values = tuple(map(float, line.split()[1:7]))
        if len(values) != 6:
            raise ValueError(f"a point has {len(values)} numbers for place and colour, not 6")
        yield values
