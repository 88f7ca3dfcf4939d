"""Compressed splat `.ply` files of PlayCanvas and SuperSplat: 16 bytes a splat, chunks of 256 with own bounds.

The layout is that of splat-transform's `decompress-ply.ts` (https://github.com/playcanvas/splat-transform).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._ply_table import Element, Header, read_rows
from .constants import SH_C0

_CHUNK = 256  # splats
_VERTEX = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SH_RANGE = 8.0  # of all harmonics, about 0
_RESTS = (9, 24, 45)  # harmonics beyond the constant ones, of degree 1, 2 and 3
Arrays = dict[str, NDArray[np.float32]]


def is_compressed(header: Header) -> bool:
    """Whether a file has such rows."""
    return any(name in _VERTEX for element in header.elements for name, _ in element.properties)


def read_compressed(path: Path, header: Header) -> Arrays:
    """Means [N,3], quats [N,4] (wxyz), scales [N,3], opacities [N] and harmonics [N,K,3], all activated.

    Raises:
        ValueError: the file is damaged or of another layout; the message names it.
    """
    names = [element.name for element in header.elements]
    if names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]) or header.kind == "ascii":
        raise ValueError(f"{path} is a compressed .ply of an unknown layout: {header.kind} with {', '.join(names)}")
    count = header.elements[1].count
    _check(path, header.elements, count)
    chunks, packed, *rest = read_rows(path, header, len(names))
    chunk = np.arange(count) // _CHUNK

    def between(low: str, high: str, share: NDArray[np.float32]) -> NDArray[np.float32]:
        a, b = chunks[low].astype(np.float32)[chunk], chunks[high].astype(np.float32)[chunk]
        return np.asarray(a * (1 - share) + b * share, dtype=np.float32)

    def triple(kind: str, letters: str, shares: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        return np.stack(
            [between(f"min_{kind}{c}", f"max_{kind}{c}", s) for c, s in zip(letters, shares, strict=True)], -1
        )

    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is found by whoever called
        means = triple("", "xyz", _shares(packed["packed_position"], (11, 10, 11)))
        scales = np.exp(triple("scale_", "xyz", _shares(packed["packed_scale"], (11, 10, 11))))
        *rgb, opacities = _shares(packed["packed_color"], (8, 8, 8, 8))
        colors = triple("", "rgb", rgb) if "min_r" in (chunks.dtype.names or ()) else np.stack(rgb, -1)
    harmonics = ((colors - 0.5) / np.float32(SH_C0))[:, None]
    if rest:
        stored = np.stack([rest[0][f"f_rest_{i}"] for i in range(len(rest[0].dtype.names or ()))], -1)
        share = np.where(stored == 0, 0, np.where(stored == 255, 1, (stored.astype(np.float32) + 0.5) / 256))
        higher = ((share - 0.5) * _SH_RANGE).reshape(count, 3, -1).transpose(0, 2, 1)
        harmonics = np.concatenate((harmonics, higher), 1)
    found = {
        "means": means,
        "quats": _quats(packed["packed_rotation"]),
        "scales": scales,
        "opacities": opacities,
        "harmonics": harmonics,
    }
    return {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in found.items()}


def _check(path: Path, elements: tuple[Element, ...], count: int) -> None:
    """Whether each element has its rows and properties."""
    bounds = [f"{end}_{kind}{c}" for kind in ("", "scale_") for end in ("min", "max") for c in "xyz"]
    colors = [f"{end}_{c}" for end in ("min", "max") for c in "rgb"]
    chunk, vertex, *rest = elements
    has = {name for name, kind in chunk.properties if kind in ("float", "float32")}
    packed = {name for name, kind in vertex.properties if kind in ("uint", "uint32")}
    missing = [name for name in bounds if name not in has] + [name for name in _VERTEX if name not in packed]
    if has & set(colors):
        missing += [name for name in colors if name not in has]
    if missing:
        raise ValueError(f"{path} has no property {missing[0]!r} of the type that a compressed .ply has")
    if chunk.count != -(-count // _CHUNK):
        raise ValueError(f"{path} has {chunk.count} chunks for {count} splats; {-(-count // _CHUNK)} were expected")
    for element in rest:
        wanted = {(f"f_rest_{i}", kind) for i in range(len(element.properties)) for kind in ("uchar", "uint8")}
        if len(element.properties) not in _RESTS or not set(element.properties) <= wanted or element.count != count:
            raise ValueError(
                f"{path} has {element.count} rows of {len(element.properties)} harmonics for {count} splats; "
                "degrees 1 to 3 have 9, 24 or 45"
            )


def _shares(words: NDArray[np.uint32], bits: tuple[int, ...]) -> list[NDArray[np.float32]]:
    """Numbers in [0,1] of so many bits each, the first in the highest."""
    left, found = sum(bits), []
    for width in bits:
        left -= width
        most = (1 << width) - 1
        found.append(((words >> np.uint32(left)) & np.uint32(most)).astype(np.float32) / np.float32(most))
    return found


def _quats(words: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Quaternions [N,4] (wxyz) from two bits that name the largest component and ten for each other one."""
    words = words.astype(np.uint32)
    small = (np.stack(_shares(words, (10, 10, 10)), -1) - np.float32(0.5)) * np.float32(np.sqrt(2.0))
    largest = (words >> np.uint32(30)).astype(np.int64)[:, None]
    places = np.arange(3)[None] + (np.arange(3)[None] >= largest)
    quats = np.empty((len(words), 4), dtype=np.float32)
    np.put_along_axis(quats, places, small, 1)
    rest = np.sqrt(np.maximum(1 - (small**2).sum(-1, keepdims=True), 0))
    np.put_along_axis(quats, largest, rest, 1)
    return quats
