"""People to train on: captures, shards, or a generator that makes them when first asked."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Protocol

from uika.data import Capture, DataError, Sample, open_capture
from uika.data.capture import DESCRIPTION, is_capture, parse_frame
from uika.data.decoding import build_sample, read_arrays
from uika.data.shard_index import open_index
from uika.data.shards import PICTURES, picture_files
from uika.errors import UikaError

SYNTHETIC = "synthetic"
_CANONICAL = "canonical.npz"
_OPEN = 64  # captures and shards whose descriptions stay in memory


class Person(Protocol):
    """The images of one person."""

    def __len__(self) -> int:
        """The number of images."""

    def sample(self, index: int) -> Sample:
        """Read one image."""


class People(Protocol):
    """A set of people; must survive pickling, since worker processes read from it."""

    def __len__(self) -> int:
        """The number of people."""

    def __getitem__(self, index: int) -> Person:
        """Open one of them."""


class Shard:
    """A tar file in webdataset layout, read at random through an index of its entries."""

    def __init__(self, path: Path) -> None:
        """Open the file's index.

        Raises:
            DataError: it is not a shard or holds no image.
        """
        self._path = path
        self._index = open_index(path)
        self._rows = self._index.rows_with(PICTURES)
        if not self._rows:
            raise DataError(f"{path}: holds no images")
        shared = self._index.rows_with((_CANONICAL,))
        name = f"{path}/{self._index.keys[shared[0]]}.{_CANONICAL}" if shared else ""
        self._canonical = read_arrays(self._read(shared[0], _CANONICAL), name) if shared else {}

    def __len__(self) -> int:
        """The number of images."""
        return len(self._rows)

    def sample(self, index: int) -> Sample:
        """Read one image.

        Raises:
            DataError: an entry cannot be used; the message names it.
        """
        row = self._rows[index]
        key = self._index.keys[row]
        names = picture_files(key, self._extensions(row))
        try:
            entry = json.loads(self._read(row, "json"))
        except (KeyError, ValueError) as error:
            raise DataError(f"{self._path}/{key}.json: is missing or not complete JSON") from error
        contents = {kind: self._read(row, name.partition(".")[2]) for kind, name in names.items()}
        frame = parse_frame(entry, names, f"{self._path}/{key}.json", 0)
        return build_sample(frame, contents, self._canonical, str(self._path), key.partition("_")[0])

    def _extensions(self, row: int) -> set[str]:
        return {name for name in self._index.extensions if self._index.place(row, name)}

    def _read(self, row: int, extension: str) -> bytes:
        place = self._index.place(row, extension)
        if place is None:
            raise KeyError(extension)
        offset, size = place
        with self._path.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
        if len(data) != size:
            raise DataError(f"{self._path}: is truncated; make it again")
        return data


def left_out(person: Person) -> tuple[str, ...]:
    """Sentences on what of a person's files is not used."""
    if not isinstance(person, Capture):
        return ()
    count = len(person.skipped)
    frames = f"{person.folder}: {count} of {count + len(person)} frames are left out; the first: "
    return (*person.notes, *((frames + person.skipped[0],) if count else ()))


@lru_cache(maxsize=_OPEN)
def open_person(path: Path) -> Person:
    """A capture folder or a shard, kept open for the next time."""
    return Shard(path) if path.suffix == ".tar" else open_capture(path)


class Stored:
    """People on disk."""

    def __init__(self, folders: Sequence[Path]) -> None:
        """Find the captures and shards in folders.

        A folder may be a capture itself, hold captures or shards, or be what `uika synthesize` wrote.

        Raises:
            UikaError: a folder holds none.
        """
        self._paths = [path for folder in folders for path in find_people(folder)]

    def __len__(self) -> int:
        """The number of people."""
        return len(self._paths)

    def __getitem__(self, index: int) -> Person:
        """Open one of them."""
        return open_person(self._paths[index])


class Synthetic:
    """Procedural people, rendered when first asked for and kept as captures."""

    def __init__(
        self, folder: Path, count: int = 1000, views: int = 9, frames: int = 3, size: int = 256, seed: int = 0
    ) -> None:
        """Arguments as in `uika.data.Synthesis`; `folder` keeps what was made."""
        self._folder, self._count = folder, count
        self._views, self._frames, self._size, self._seed = views, frames, size, seed

    def __len__(self) -> int:
        """The number of people."""
        return self._count

    def __getitem__(self, index: int) -> Person:
        """Open one of them, and make it before if it is new."""
        path = self._folder / f"{self._seed}-{self._views}-{self._frames}-{self._size}" / f"{index:06d}"
        if not path.exists():
            self._make(index, path)
        return open_person(path)

    def _make(self, index: int, path: Path) -> None:
        import shutil
        import tempfile

        from uika.data.identity import generate_identity
        from uika.head import load_head

        path.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=".", suffix=".partial", dir=path.parent))
        try:
            head = load_head().without_bust
            for name, data in generate_identity(head, self._seed, index, self._views, self._frames, self._size):
                target = partial / name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(data)
            partial.rename(path)
        except OSError:
            # Another process may have been faster; its files are the same.
            if not path.exists():
                raise
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def find_people(folder: Path) -> list[Path]:
    """Captures and shards in a folder, sorted; captures are preferred where both hold the same people.

    Raises:
        UikaError: there are none.
    """
    if is_capture(folder):
        return [folder]
    if not folder.is_dir():
        raise UikaError(f"{folder}: no such folder; give folders with captures or shards, or '{SYNTHETIC}'")
    for root in (folder / "captures", folder):
        captures = sorted(path.parent for path in root.glob(f"[!.]*/{DESCRIPTION}"))
        if captures:
            return captures
    shards = sorted((folder / "shards").glob("*.tar")) or sorted(folder.glob("*.tar"))
    if not shards:
        raise UikaError(f"{folder}: holds neither captures (folders with {DESCRIPTION}) nor shards (.tar)")
    return shards
