"""Writing a shard moment by moment, so that an interrupted one is gone on with where it stopped."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from types import TracebackType

from uika.data.shard_index import Entry, build_index, write_index

_ZERO = b"\0"


class ShardWriter:
    """A tar file under a temporary name, which it keeps until it is complete; equal entries give equal bytes."""

    def __init__(self, path: Path, last: str) -> None:
        """Open, or go on with what is there.

        Args:
            path: the shard's final name.
            last: extension of the entry that completes a group; what follows the last one is written again.
        """
        self.path = path
        self._partial = path.with_name(f".{path.stem}.partial{path.suffix}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.entries = _whole_groups(self._partial, last)
        self._file = self._partial.open("r+b" if self._partial.exists() else "w+b")
        self._cut()

    def __enter__(self) -> ShardWriter:
        """Use as a context, which closes the file."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; the temporary file stays unless `finish` renamed it."""
        self._file.close()

    def keep(self, count: int) -> None:
        """Forget all but the first `count` entries."""
        self.entries = self.entries[:count]
        self._cut()

    def add(self, name: str, data: bytes) -> None:
        """Append one entry."""
        info = tarfile.TarInfo(name)
        info.size = len(data)
        self._file.write(info.tobuf(tarfile.USTAR_FORMAT))
        self.entries.append((name, self._file.tell(), len(data)))
        self._file.write(data + _ZERO * (-len(data) % tarfile.BLOCKSIZE))

    def flush(self) -> None:
        """Hand what was added to the system."""
        self._file.flush()

    def finish(self) -> None:
        """End the tar file, give it its name and write its index."""
        self._file.write(_ZERO * (2 * tarfile.BLOCKSIZE))
        self._file.write(_ZERO * (-self._file.tell() % tarfile.RECORDSIZE))
        self._file.close()
        self._partial.replace(self.path)
        write_index(self.path, build_index(self.entries))

    def _cut(self) -> None:
        """End the file behind the last entry."""
        end = max((_padded(offset + size) for _, offset, size in self.entries), default=0)
        self._file.truncate(end)
        self._file.seek(end)


def _whole_groups(partial: Path, last: str) -> list[Entry]:
    """Entries of an unfinished file up to the last one with the extension `last`."""
    if not partial.is_file():
        return []
    found: list[Entry] = []
    size = partial.stat().st_size
    with partial.open("rb") as file:
        while len(header := file.read(tarfile.BLOCKSIZE)) == tarfile.BLOCKSIZE:
            try:
                info = tarfile.TarInfo.frombuf(header, "utf-8", "strict")
            except (tarfile.HeaderError, UnicodeDecodeError):
                break
            if file.tell() + info.size > size:
                break
            found.append((info.name, file.tell(), info.size))
            file.seek(_padded(file.tell() + info.size), io.SEEK_SET)
    ends = [place for place, entry in enumerate(found) if entry[0].partition(".")[2] == last]
    return found[: ends[-1] + 1] if ends else []


def _padded(size: int) -> int:
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
