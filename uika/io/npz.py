"""Read numpy's files when they come from strangers: plain numbers and text only, and no more memory than they hold."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

MAX_BYTES = 1 << 29  # of all arrays of one file, unpacked; FLAME's take a tenth of it
_CHUNK = 1 << 20
_PLAIN = "?biufUS"  # numpy's kinds of numbers and text


class ArraysError(ValueError):
    """A file that is damaged, holds objects, or promises more than it holds; the message says what, not which file."""


def read_npz(source: Path | bytes, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file, or of its bytes, by name.

    What a header promises is compared with what the archive holds before memory is taken for it.

    Args:
        source: the file or its content.
        names: read only these; None reads all.

    Raises:
        ArraysError: damaged, of too many bytes, or with an array that holds neither numbers nor text.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if names is not None:
                members = {name: info for name, info in members.items() if name in names}
            if sum(info.file_size for info in members.values()) > MAX_BYTES:
                raise ArraysError(f"holds more than {MAX_BYTES >> 20} MiB of arrays")
            for info in members.values():
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ArraysError(f"member '{info.filename}' is packed in a way that numpy does not use")
            found = {}
            for name, info in members.items():
                with archive.open(info) as member:
                    found[name] = _read(member, info.file_size)
            return found
    except ArraysError:
        raise
    except Exception as error:  # damage makes zipfile, zlib and numpy fail in a dozen ways
        raise ArraysError(_sentence(error)) from error


def read_npy(path: Path) -> np.ndarray:
    """The array of an `.npy` file.

    Raises:
        ArraysError: as `read_npz`.
    """
    try:
        with path.open("rb") as file:
            return _read(file, path.stat().st_size)
    except ArraysError:
        raise
    except Exception as error:  # damage makes zipfile, zlib and numpy fail in a dozen ways
        raise ArraysError(_sentence(error)) from error


def _read(file: IO[bytes], size: int) -> np.ndarray:
    """One array of a file of `size` bytes."""
    version = npy.read_magic(file)
    if version == (1, 0):
        shape, fortran, dtype = npy.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran, dtype = npy.read_array_header_2_0(file)
    else:
        raise ArraysError(f"has an array of the format version {version}")
    if dtype.kind not in _PLAIN:
        raise ArraysError(f"has an array of type {dtype}; only numbers and text are read")
    count = math.prod(shape)
    if any(side < 0 for side in shape) or count * dtype.itemsize > min(size, MAX_BYTES):
        raise ArraysError(f"has an array of shape {shape}, more than the file holds")
    flat = np.zeros(count, dtype)
    target, at = flat.view(np.uint8) if flat.nbytes else np.zeros(0, np.uint8), 0
    while at < len(target):
        if not (part := file.read(min(_CHUNK, len(target) - at))):
            raise ArraysError("is cut short")
        target[at : at + len(part)] = np.frombuffer(part, np.uint8)
        at += len(part)
    return flat.reshape(shape, order="F" if fortran else "C")


def _sentence(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__
