"""`transforms.json` of nerfstudio and instant-ngp, and the folders of NeRF-synthetic."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._ply_table import read_header, read_rows, vertices
from .captures import Capture, Photo, is_there, rigid

_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes to OpenCV's


def read_transforms(path: Path) -> Capture:
    """A `transforms.json` with camera-to-world matrices in OpenGL axes, its pictures relative to it.

    Raises:
        ValueError: it cannot be used; the message names it.
    """
    document = _document(path)
    photos = [_photo(path, document, frame, index) for index, frame in enumerate(document["frames"])]
    points, colors = (None, None)
    if isinstance(document.get("ply_file_path"), str):
        points, colors = _point_cloud(path.parent / document["ply_file_path"])
    return Capture(tuple(photos), (), points, colors)


def read_blender(folder: Path) -> Capture:
    """A folder of NeRF-synthetic: `transforms_train.json` is learned from, `transforms_test.json` is held out.

    Raises:
        ValueError: a file cannot be used; the message names it.
    """
    parts: list[tuple[Photo, ...]] = []
    for name in ("transforms_train.json", "transforms_test.json"):
        path = folder / name
        document = _document(path) if path.is_file() else {"frames": []}
        parts.append(tuple(_photo(path, document, frame, i) for i, frame in enumerate(document["frames"])))
    return Capture(parts[0], parts[1])


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: cannot be read as JSON ({error})") from None
    if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
        raise ValueError(f"{path}: has no list 'frames'")
    return document


def _photo(path: Path, document: dict[str, Any], frame: Any, index: int) -> Photo:
    source = f"{path}: frame {index}"
    try:
        known = {**document, **frame}
        file = _found(path.parent / str(frame["file_path"]))
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
        if matrix.shape != (4, 4):
            raise ValueError("transform_matrix must be 4x4")
        width, height = _size(known, file)
        fx, fy = _focal(known, width, height)
        cx, cy = float(known.get("cx", width / 2)), float(known.get("cy", height / 2))
        model = str(known.get("camera_model", "PINHOLE"))
        bent = [name for name in _DISTORTION if abs(float(known.get(name, 0.0))) > 0]
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(f"{source} cannot be used ({type(error).__name__}: {error})") from None
    if model not in ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV") or bent:
        raise ValueError(f"{source}: undistort the pictures first; only pinhole cameras are trained ({model} {bent})")
    values = (fx, fy, cx, cy)
    if not all(map(math.isfinite, values)) or min(fx, fy) <= 0:
        raise ValueError(f"{source}: focal lengths and centre must be finite, focal lengths positive, not {values}")
    with contextlib.suppress(np.linalg.LinAlgError):
        matrix = np.asarray(np.linalg.inv(matrix @ _FLIP), dtype=np.float64)  # no inverse: no rotation
    if not 0 < width < 1 << 16 > height > 0:
        raise ValueError(f"{source}: its picture cannot have {width} x {height} pixels")
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Photo(file, rigid(matrix, source), K, width, height)


def _found(path: Path) -> Path:
    """NeRF-synthetic leaves the ending out."""
    return next((found for suffix in _SUFFIXES if is_there(found := path.with_name(path.name + suffix))), path)


def _size(known: dict[str, Any], file: Path) -> tuple[int, int]:
    if "w" in known and "h" in known:
        return int(known["w"]), int(known["h"])
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("reading photos needs pillow; run: pip install pillow") from error
    try:
        with Image.open(file) as image:
            return image.size
    except OSError as error:
        raise ValueError(f"{file} cannot be read as a picture: {error}") from None


def _focal(known: dict[str, Any], width: int, height: int) -> tuple[float, float]:
    """Focal lengths in pixels from any of the ways in which they are written."""
    if "fl_x" in known:
        return float(known["fl_x"]), float(known.get("fl_y", known["fl_x"]))
    if "camera_angle_x" in known:
        across = width / 2 / math.tan(float(known["camera_angle_x"]) / 2)
        down = height / 2 / math.tan(float(known["camera_angle_y"]) / 2) if "camera_angle_y" in known else across
        return across, down
    raise KeyError("fl_x or camera_angle_x")


def _point_cloud(path: Path) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Points [P,3] of a `.ply`, and their colours [P,3] in [0,1] if it has any."""
    if not is_there(path):
        raise ValueError(f"{path}: the data set names this file of points, which is not there")
    header = read_header(path)
    vertices(path, header)
    table = read_rows(path, header, 1)[0]
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"{path}: has no properties x, y, z")
    points = np.stack([table[name].astype(np.float32) for name in "xyz"], -1)
    colors = None
    if {"red", "green", "blue"} <= set(names):
        colors = torch.from_numpy(np.stack([table[c].astype(np.float32) / 255 for c in ("red", "green", "blue")], -1))
    return torch.from_numpy(points[np.isfinite(points).all(-1)]), colors
