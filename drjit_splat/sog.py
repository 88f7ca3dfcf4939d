"""PlayCanvas's `.sog` files: pictures whose pixels are splats (https://developer.playcanvas.com, "The SOG Format")."""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ._inputs import check_finite
from .ply import SplatFile

MAX_SPLATS = 20_000_000  # of one file
_MOST_BYTES = 1 << 28  # of one picture or of the description, packed
_VERSION = 2
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}  # bands -> harmonics beyond the constant one
_ACROSS = 64  # palette entries in a row
_LARGEST = 252  # stands in a quaternion's fourth byte, plus the number of its largest component


def load_sog(path: str | os.PathLike[str]) -> SplatFile:
    """Read a bundle of version 2.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no such bundle, is damaged or of another version; the message names it.
        ModuleNotFoundError: pillow, which decodes the pictures, is not installed.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            found = _read(archive)
    except FileNotFoundError:
        raise
    except (
        *(zipfile.BadZipFile, zlib.error, OSError, RuntimeError, NotImplementedError, EOFError),
        *(KeyError, TypeError, ValueError, IndexError, ArithmeticError, RecursionError),
    ) as error:
        raise ValueError(f"{path} is no .sog file or is damaged ({type(error).__name__}: {error})") from None
    splats = SplatFile(*(torch.from_numpy(np.ascontiguousarray(value, dtype=np.float32)) for value in found))
    try:
        check_finite(**vars(splats))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return splats


def _read(archive: zipfile.ZipFile) -> tuple[NDArray[Any], ...]:
    meta = json.loads(_member(archive, "meta.json"))
    if meta["version"] != _VERSION:
        raise ValueError(f"version {meta['version']!r}; {_VERSION} can be read")
    count = meta["count"]
    if not isinstance(count, int) or not 0 <= count <= MAX_SPLATS:
        raise ValueError(f"{count!r} splats; at most {MAX_SPLATS:,} can be read")

    def pixels(part: dict[str, Any], index: int = 0) -> NDArray[np.uint8]:
        """The first `count` pixels [N,4] of a picture."""
        whole = _picture(archive, part["files"][index]).reshape(-1, 4)
        if len(whole) < count:
            raise ValueError(f"{part['files'][index]} has {len(whole)} pixels for {count} splats")
        return whole[:count]

    low, high = (pixels(meta["means"], index)[:, :3].astype(np.uint16) for index in (0, 1))
    least, most = (np.array(meta["means"][name], dtype=np.float64).reshape(3) for name in ("mins", "maxs"))
    logs = least + (most - least) * (low | high << 8) / 65535
    means = np.sign(logs) * np.expm1(np.abs(logs))
    scales = np.exp(_codebook(meta["scales"])[pixels(meta["scales"])[:, :3]])
    base = pixels(meta["sh0"])
    harmonics = _codebook(meta["sh0"])[base[:, :3]][:, None]
    if meta.get("shN") is not None:
        harmonics = np.concatenate((harmonics, _palette(archive, meta["shN"], pixels)), 1)
    return means, _quats(pixels(meta["quats"])), scales, base[:, 3] / 255, harmonics


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    entry = archive.getinfo(str(name))
    if entry.file_size > _MOST_BYTES:
        raise ValueError(f"{name} has {entry.file_size:,} bytes; at most {_MOST_BYTES:,} are read")
    with archive.open(entry) as file:
        return file.read(_MOST_BYTES)


def _picture(archive: zipfile.ZipFile, name: str) -> NDArray[np.uint8]:
    """A picture [H,W,4]."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("reading .sog files needs pillow; run: pip install pillow") from error
    try:
        with Image.open(io.BytesIO(_member(archive, name))) as image:
            if image.width * image.height > 2 * MAX_SPLATS:
                raise ValueError(f"{name} has {image.width} x {image.height} pixels")
            return np.asarray(image.convert("RGBA"))
    except Image.DecompressionBombError as error:
        raise ValueError(f"{name}: {error}") from None


def _codebook(part: dict[str, Any]) -> NDArray[np.float64]:
    return np.array(part["codebook"], dtype=np.float64).reshape(256)


def _palette(archive: zipfile.ZipFile, part: dict[str, Any], pixels: Any) -> NDArray[np.float64]:
    """Harmonics [N,K-1,3] beyond the constant ones."""
    bands, entries = part["bands"], int(part["count"])
    if bands not in _COEFFICIENTS:
        raise ValueError(f"{bands!r} bands of harmonics; 1 to 3 can be read")
    each, centroids = _COEFFICIENTS[bands], _picture(archive, part["files"][0])
    if centroids.shape[1] != _ACROSS * each or centroids.shape[0] * _ACROSS < entries:
        raise ValueError(
            f"{part['files'][0]} has {centroids.shape[1]} x {centroids.shape[0]} pixels for {entries} entries"
        )
    table = centroids[..., :3].reshape(-1, _ACROSS, each, 3).reshape(-1, each, 3)
    labels = pixels(part, 1)[:, 0].astype(np.int64) | pixels(part, 1)[:, 1].astype(np.int64) << 8
    if len(labels) and int(labels.max()) >= entries:
        raise ValueError(f"a splat has the harmonics {labels.max()}, of {entries}")
    return _codebook(part)[table[labels]]


def _quats(rgba: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Quaternions [N,4] (wxyz) from their three smaller components, in order, and the number of the largest."""
    largest = rgba[:, 3].astype(np.int64)[:, None] - _LARGEST
    if len(rgba) and int(largest.min()) < 0:
        raise ValueError("a rotation does not say which of its components is the largest")
    small = (rgba[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    quats = np.empty((len(rgba), 4))
    places = np.arange(3)[None] + (np.arange(3)[None] >= largest)
    np.put_along_axis(quats, places, small, 1)
    np.put_along_axis(quats, largest, np.sqrt(np.maximum(1 - (small**2).sum(-1, keepdims=True), 0)), 1)
    return quats
