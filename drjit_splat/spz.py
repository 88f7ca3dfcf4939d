"""Niantic's compressed splat files, `.spz` (https://github.com/nianticlabs/spz): about a tenth of a `.ply`.

Their axes are right, up, back; ours are those of splat `.ply` files, right, down, forward, and are converted.
"""

from __future__ import annotations

import gzip
import os
import secrets
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .ply import SplatFile

MAGIC = b"NGSP"
VERSION = 3  # that is written
MAX_SPLATS = 10_000_000  # of one file, as the format's own program allows
FRACTION_BITS = 12
_MOST_PACKED = 200  # bytes of splats in one of the file; compressors reach a thousand with nothing but zeros
_MOST_BITS = 23  # of a position's 24, one is its sign
_COLOR_SCALE = 0.15  # of the constant harmonic
_SH_BUCKETS = (8, 16)  # steps of harmonics of the first degree and of the others
_HALF_ROOT = float(np.sqrt(0.5))
_CHUNK = 1 << 20
# Signs of the harmonics 1 to 15 when Y and Z are turned over: those of odd powers of y z.
_SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
_FLIP = np.array([1.0, -1.0, -1.0], dtype=np.float32)


def load_spz(path: str | os.PathLike[str]) -> SplatFile:
    """Read a file of version 2 or 3, and of version 4 where `zstandard` is installed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no such file, is damaged or cut short, or of another version; the message names it.
        ModuleNotFoundError: version 4 needs `zstandard`.
    """
    path = Path(path)
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        version, count, degree, bits, streams = _legacy(path, data)
    elif data[:4] == MAGIC:
        version, count, degree, bits, streams = _current(path, data)
    else:
        raise ValueError(f"{path} is no .spz file")
    position, opacity, color, scale, turn, harmonics = streams
    means = _FLIP * _fixed_point(position, count) / np.float32(2**bits)
    quats = _smallest_three(turn) if version >= 3 else _first_three(turn)
    quats[:, 2:] *= -1
    coefficients = (np.frombuffer(color, np.uint8).astype(np.float32) / 255 - 0.5) / _COLOR_SCALE
    K = (degree + 1) ** 2
    higher = (np.frombuffer(harmonics, np.uint8).astype(np.float32) - 128).reshape(count, K - 1, 3) / 128
    higher = higher * _SH_SIGNS[: K - 1, None]
    sh = np.concatenate((coefficients.reshape(count, 1, 3), higher), 1)
    scales = np.exp(np.frombuffer(scale, np.uint8).astype(np.float32).reshape(count, 3) / 16 - 10)
    opacities = np.frombuffer(opacity, np.uint8).astype(np.float32) / 255
    return SplatFile(*(torch.from_numpy(np.ascontiguousarray(v)) for v in (means, quats, scales, opacities, sh)))


def save_spz(
    path: str | os.PathLike[str],
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    harmonics: Tensor,  # [N, K, 3]
    *,
    fraction_bits: int = FRACTION_BITS,
) -> None:
    """Write a file of version 3; it appears under its name only when it is complete.

    Positions are kept to 2^-12 of a unit, less where the scene is larger than 2,048; colours, scales and opacities to
    eight bits, rotations to 10 bits a component.

    Args:
        path: file to write.
        means: [N, 3] centres.
        quats: [N, 4] rotations, wxyz.
        scales: [N, 3] standard deviations.
        opacities: [N] in [0, 1].
        harmonics: [N, K, 3] with K 1, 4, 9 or 16.
        fraction_bits: of positions, 0 to 23; fewer are taken where the scene is too large for them. More make a finer
            grid for what is small, and a larger file.

    Raises:
        ValueError: there are too many splats, `fraction_bits` lies outside its range, K is another number, or a value
            is not finite or too far away.
    """
    count, K = len(means), harmonics.shape[1]
    if K not in (1, 4, 9, 16) or count > MAX_SPLATS:
        raise ValueError(f"harmonics: {K} a channel and {count:,} splats; files hold 1, 4, 9 or 16 and {MAX_SPLATS:,}")
    if not 0 <= fraction_bits <= _MOST_BITS:
        raise ValueError(f"fraction_bits must lie between 0 and {_MOST_BITS}, not {fraction_bits}")
    m, q, s, o, h = (value.detach().cpu().double().numpy() for value in (means, quats, scales, opacities, harmonics))
    for name, values in (("means", m), ("quats", q), ("scales", s), ("opacities", o), ("harmonics", h)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: every value must be finite")
    farthest = float(np.abs(m).max(initial=1e-3))
    bits = min(fraction_bits, int(np.floor(23 - np.log2(farthest) - 1e-6)))
    if bits < 0:
        raise ValueError(f"means: {farthest:g} is farther away than the format can say")
    fixed = np.rint(m * _FLIP * 2**bits).astype("<i4")
    position = fixed.view(np.uint8).reshape(count, 3, 4)[..., :3]
    turned = q * (1, 1, -1, -1)
    higher = np.rint(h[:, 1:] * _SH_SIGNS[: K - 1, None] * 128 + 128).astype(np.int64)
    bucket = np.where(np.arange(K - 1) < 3, *_SH_BUCKETS)[:, None]
    parts = (
        position,
        _bytes(o * 255),
        _bytes((h[:, 0] * _COLOR_SCALE + 0.5) * 255),
        _bytes((np.log(np.maximum(s, 1e-30)) + 10) * 16),
        _pack_smallest_three(turned),
        ((higher + bucket // 2) // bucket * bucket).clip(0, 255).astype(np.uint8),
    )
    degree = round(K**0.5) - 1
    header = MAGIC + struct.pack("<IIBBBB", VERSION, count, degree, bits, 0, 0)
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("wb") as raw, gzip.GzipFile("", "wb", fileobj=raw, mtime=0) as file:
            file.write(header)
            for part in parts:
                file.write(np.ascontiguousarray(part).tobytes())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _sizes(version: int, count: int, degree: int) -> list[int]:
    """Bytes of positions, opacities, colours, scales, rotations and harmonics."""
    higher = (degree + 1) ** 2 - 1
    return [count * each for each in (9, 1, 3, 3, 4 if version >= 3 else 3, 3 * higher)]


def _checked(path: Path, size: int, version: int, count: int, degree: int, bits: int) -> None:
    if degree > 3 or count > MAX_SPLATS or bits > _MOST_BITS:
        raise ValueError(
            f"{path} says {count:,} splats with harmonics of degree {degree} and {bits} bits; "
            f"at most {MAX_SPLATS:,}, degree 3 and {_MOST_BITS} can be read"
        )
    unpacked = sum(_sizes(version, count, degree))
    if unpacked > max(_MOST_PACKED * size, 1 << 26):
        raise ValueError(
            f"{path} says {count:,} splats, {unpacked:,} bytes in {size:,}: more than splats can be packed"
        )


def _legacy(path: Path, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    unpacker = zlib.decompressobj(wbits=31)
    try:
        found = bytearray(unpacker.decompress(data, _CHUNK))
        if len(found) < 16 or found[:4] != MAGIC:
            raise ValueError(f"{path} is no .spz file")
        version, count, degree, bits, _, _ = struct.unpack("<IIBBBB", found[4:16])
        if version not in (2, 3):
            raise ValueError(f"{path} is of version {version}; 2, 3 and 4 can be read")
        _checked(path, len(data), version, count, degree, bits)
        needed = 16 + sum(_sizes(version, count, degree))
        # No more is unpacked than the header says, whatever the file would become.
        while len(found) < needed and not unpacker.eof:
            more = unpacker.decompress(unpacker.unconsumed_tail, min(_CHUNK, needed - len(found)))
            if not more:
                break
            found += more
    except zlib.error as error:
        raise ValueError(f"{path} is damaged ({error})") from None
    if len(found) < needed:
        raise ValueError(f"{path} is cut short: {count:,} splats need {needed:,} bytes, it has {len(found):,}")
    return version, count, degree, bits, _cut(bytes(found[16:needed]), _sizes(version, count, degree))


def _current(path: Path, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    try:
        from zstandard import ZstdDecompressor, ZstdError
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{path}: version 4 needs zstandard; run: pip install zstandard") from error
    if len(data) < 32:
        raise ValueError(f"{path} is cut short")
    version, count, degree, bits, _, streams, table = struct.unpack_from("<IIBBBBI", data, 4)
    if version != 4:
        raise ValueError(f"{path} is of version {version}; 2, 3 and 4 can be read")
    _checked(path, len(data), version, count, degree, bits)
    sizes = _sizes(version, count, degree)
    wanted = [size for size in sizes if size] if streams < len(sizes) else sizes
    if streams != len(wanted) or table + 16 * streams > len(data):
        raise ValueError(f"{path} is damaged: its table does not fit its header")
    at, found = table + 16 * streams, []
    for index, size in enumerate(wanted):
        packed, unpacked = struct.unpack_from("<QQ", data, table + 16 * index)
        if unpacked != size or packed > len(data) - at:
            raise ValueError(f"{path} is damaged: its table does not fit its header")
        try:
            found.append(ZstdDecompressor().decompress(data[at : at + packed], max_output_size=size) if size else b"")
        except ZstdError as error:
            raise ValueError(f"{path} is damaged ({error})") from None
        if len(found[-1]) != size:
            raise ValueError(f"{path} is cut short")
        at += packed
    return version, count, degree, bits, _cut(b"".join(found), sizes)


def _cut(data: bytes, sizes: list[int]) -> list[bytes]:
    ends = np.cumsum(sizes)
    return [data[end - size : end] for end, size in zip(ends, sizes, strict=True)]


def _fixed_point(data: bytes, count: int) -> NDArray[np.float32]:
    """Signed numbers [N,3] of three bytes each."""
    raw = np.frombuffer(data, np.uint8).reshape(count, 3, 3).astype(np.int32)
    value = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    return (value - ((value & 0x800000) << 1)).astype(np.float32)


def _first_three(data: bytes) -> NDArray[np.float32]:
    """Quaternions [N,4] (wxyz) from x, y, z; w is not negative."""
    vector = np.frombuffer(data, np.uint8).astype(np.float32).reshape(-1, 3) / 127.5 - 1
    w = np.sqrt(np.maximum(1 - (vector**2).sum(-1, keepdims=True), 0))
    return np.concatenate((w, vector), -1)


def _smallest_three(data: bytes) -> NDArray[np.float32]:
    """Quaternions [N,4] (wxyz) from their three smaller components in the order x, y, z, w."""
    word = np.frombuffer(data, "<u4").astype(np.int64)
    largest = word >> 30
    result = np.zeros((len(word), 4), dtype=np.float32)
    rows = np.arange(len(word))
    for place in range(3):  # the last of the three lies in the lowest bits
        value = _HALF_ROOT * (word & 511) / 511 * np.where(word >> 9 & 1, -1.0, 1.0)
        component = 3 - place - (3 - place <= largest)
        result[rows, component] = value
        word >>= 10
    result[rows, largest] = np.sqrt(np.maximum(1 - (result**2).sum(-1), 0))
    return np.roll(result, 1, axis=1)


def _pack_smallest_three(quats: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The inverse of `_smallest_three`, [N,4] bytes; quaternions of any length, zeros stand for no rotation."""
    norm = np.linalg.norm(quats, axis=-1, keepdims=True)
    unit = np.where(norm > 1e-12, quats / np.maximum(norm, 1e-12), (1.0, 0.0, 0.0, 0.0))
    xyzw = np.roll(unit, -1, axis=1)
    largest = np.abs(xyzw).argmax(-1)
    rows = np.arange(len(xyzw))
    xyzw = xyzw * np.where(xyzw[rows, largest] < 0, -1.0, 1.0)[:, None]
    word = largest.astype(np.uint32)
    for place in range(3):
        value = xyzw[rows, place + (place >= largest)]
        magnitude = np.floor(511 * (np.abs(value) / _HALF_ROOT) + 0.5).astype(np.uint32)
        word = word << np.uint32(10) | (value < 0).astype(np.uint32) << np.uint32(9) | magnitude
    return word.astype("<u4").view(np.uint8).reshape(-1, 4)


def _bytes(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)
