"""Where the entries of a shard lie, kept beside it so that one of 100,000 images is opened without reading the tar."""

from __future__ import annotations

import tarfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uika.data.sample import DataError
from uika.io.files import replacing
from uika.io.npz import ArraysError, read_npz

SUFFIX = ".index.npz"
Entry = tuple[str, int, int]  # name, first byte, number of bytes


@dataclass(frozen=True, eq=False)
class ShardIndex:
    """N groups of entries that share the name before the first dot, sorted, and E extensions."""

    keys: list[str]  # N
    extensions: tuple[str, ...]  # E
    offsets: np.ndarray  # [N,E] int64; -1 where a group lacks the extension
    sizes: np.ndarray  # [N,E] int64

    def rows_with(self, extensions: Sequence[str]) -> list[int]:
        """Groups that have an entry with one of the extensions."""
        columns = [self.extensions.index(name) for name in extensions if name in self.extensions]
        return np.flatnonzero((self.offsets[:, columns] >= 0).any(1)).tolist() if columns else []

    def place(self, row: int, extension: str) -> tuple[int, int] | None:
        """First byte and size of an entry, or None where there is none."""
        if extension not in self.extensions:
            return None
        column = self.extensions.index(extension)
        offset = int(self.offsets[row, column])
        return None if offset < 0 else (offset, int(self.sizes[row, column]))


def build_index(entries: Iterable[Entry]) -> ShardIndex:
    """The index of entries in any order."""
    groups: dict[str, dict[str, tuple[int, int]]] = {}
    for name, offset, size in entries:
        key, _, extension = name.partition(".")
        groups.setdefault(key, {})[extension] = (offset, size)
    keys = sorted(groups)
    extensions = tuple(sorted({extension for group in groups.values() for extension in group}))
    places = np.array([[groups[key].get(extension, (-1, 0)) for extension in extensions] for key in keys], np.int64)
    places = places.reshape(len(keys), len(extensions), 2)
    return ShardIndex(keys, extensions, places[..., 0].copy(), places[..., 1].copy())


def write_index(shard: Path, index: ShardIndex) -> None:
    """Write the index of a complete shard beside it."""
    arrays = {
        "bytes": np.array(shard.stat().st_size),
        "keys": np.frombuffer("\n".join(index.keys).encode(), np.uint8),
        "extensions": np.array(index.extensions, np.str_),
        "offsets": index.offsets,
        "sizes": index.sizes.astype(np.uint32),
    }
    with replacing(index_path(shard)) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def open_index(shard: Path) -> ShardIndex:
    """The index of a shard: the one beside it where it fits the file, else made from the file.

    Raises:
        DataError: the shard is missing or damaged; the message names it.
    """
    try:
        size = shard.stat().st_size
    except OSError as error:
        raise DataError(f"{shard}: cannot be read ({error.strerror})") from error
    return _kept(shard, size) or build_index(scan(shard, size))


def scan(shard: Path, size: int) -> list[Entry]:
    """The entries of a tar file, header by header.

    Raises:
        DataError: it is no tar file, or promises more than it holds.
    """
    try:
        with tarfile.open(shard, "r:") as archive:
            found = [(info.name, info.offset_data, info.size) for info in archive if info.isfile()]
    except (OSError, EOFError, ValueError, OverflowError, tarfile.TarError) as error:
        raise DataError(f"{shard}: is not a readable shard ({error})") from error
    if any(offset + length > size for _, offset, length in found):
        raise DataError(f"{shard}: is truncated; make it again")
    return found


def index_path(shard: Path) -> Path:
    """Where a shard's index lies."""
    return shard.with_name(shard.stem + SUFFIX)


def _kept(shard: Path, size: int) -> ShardIndex | None:
    """The index beside a shard, if it is whole and of this file."""
    try:
        arrays = read_npz(index_path(shard))
        keys = arrays["keys"].astype(np.uint8).tobytes().decode().split("\n")
        extensions = tuple(str(name) for name in arrays["extensions"])
        offsets, sizes = arrays["offsets"].astype(np.int64), arrays["sizes"].astype(np.int64)
        shape = (len(keys), len(extensions))
        fits = int(arrays["bytes"]) == size and offsets.shape == sizes.shape == shape
        if not fits or bool((offsets + sizes > size).any()) or bool((offsets < -1).any()):
            return None
    except (ArraysError, KeyError, TypeError, ValueError):
        return None
    return ShardIndex(keys, extensions, offsets, sizes)
