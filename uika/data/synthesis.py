"""Writing a set of synthetic people: resumable, in shards, the same whatever the number of machines."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from uika.data.identity import Recording, record_identity
from uika.data.shard_index import open_index, write_index
from uika.data.shard_writer import ShardWriter
from uika.data.shards import EXTENSIONS, shard_entries, write_shard
from uika.errors import UikaError, install_command
from uika.head import HeadModel, load_head
from uika.io.files import check_folder, replacing

SETTINGS_FILE = "synthesis.json"
CANONICAL = "canonical_flame_param.npz"
_NOTES = ".frames"  # folder of an unfinished capture
_USUAL = {"labels": "full", "images": "png"}  # not written down
_LIMITS = {"identities": 1_000_000, "views": 64, "frames": 100_000, "size": 2048}
_HEADER = 2  # entries of a shard before those of its images


@dataclass(frozen=True)
class Synthesis:
    """What to make. Two runs with the same values write the same files, whichever shards they take."""

    output: Path
    identities: int = 1000
    views: int = 9
    frames: int = 13
    size: int = 512
    seed: int = 0
    shard: str = "0/1"  # "i/n": this run makes the identities i, i + n, i + 2n, ...
    captures: bool = True  # whether to write a folder of loose files for each person
    archives: bool = True  # whether to write a webdataset shard for each person
    labels: Literal["full", "tracked"] = "full"  # tracked: no correspondences and depths, the parameters tell them
    images: Literal["png", "jpeg"] = "png"

    @property
    def recording(self) -> Recording:
        """What is kept of each person."""
        return Recording(self.views, self.frames, self.size, self.labels, self.images)

    def part(self) -> tuple[int, int]:
        """The i and n of `shard`.

        Raises:
            UikaError: it is not two numbers i/n with 0 <= i < n.
        """
        return shard_part(self.shard)


@dataclass(frozen=True)
class SynthesisReport:
    """What a run did."""

    made: int  # people rendered by this run
    kept: int  # people that were complete before
    images: int  # images rendered by this run


def synthesize(settings: Synthesis, head: HeadModel | None = None, progress: bool = True) -> SynthesisReport:
    """Make the people of one shard that are not complete yet.

    `output/captures/000012/` holds a person as a capture (`uika.data.open_capture` reads it) and
    `output/shards/000012.tar` the same files as a webdataset shard, with its index beside it. A person appears under
    its name only when complete; a run that was killed is started again and goes on with the moment that it was at.

    Raises:
        UikaError: a value is out of range, the folder holds a set made with other values, or the disk is full.
    """
    part, parts = settings.part()
    for name, most in _LIMITS.items():
        if not 1 <= getattr(settings, name) <= most:
            raise UikaError(f"{name} must lie between 1 and {most}, not {getattr(settings, name)}")
    if settings.seed < 0 or settings.size < 16:
        raise UikaError("seed must not be negative and size at least 16 pixels")
    if not (settings.captures or settings.archives):
        raise UikaError("captures and archives are both off; nothing would be kept")
    model = (load_head() if head is None else head).without_bust
    root = check_folder(settings.output)
    wanted = range(part, settings.identities, parts)
    made = kept = 0
    with _disk_errors(root), _bar(len(wanted) * settings.views * settings.frames, progress) as bar:
        _agree(root, settings, model)
        for identity in wanted:
            if _complete(root, identity, settings):
                kept += 1
                bar.skip(settings.views * settings.frames)
                continue
            _make(root, identity, settings, model, bar)
            made += 1
    return SynthesisReport(made, kept, made * settings.views * settings.frames)


def shard_part(text: str, name: str = "shard") -> tuple[int, int]:
    """The i and n of "i/n".

    Raises:
        UikaError: it is not two numbers i/n with 0 <= i < n; the message says `name`.
    """
    first, _, count = text.partition("/")
    if not (first.isdecimal() and count.isdecimal() and int(first) < int(count)):
        raise UikaError(f"{name} must be i/n with 0 <= i < n, such as 0/2, not '{text}'")
    return int(first), int(count)


def identity_name(identity: int) -> str:
    """The name of a person's folder and shard."""
    return f"{identity:06d}"


def _make(root: Path, identity: int, settings: Synthesis, head: HeadModel, bar: _Bar) -> None:
    name = identity_name(identity)
    shard = root / "shards" / f"{name}.tar"
    if not settings.captures:
        _record(shard, identity, settings, head, bar)
        return
    folder = root / "captures" / name
    if not folder.exists():
        partial = folder.with_name(f".{name}.partial")
        start = _complete_moments(partial, settings)
        bar.skip(start * settings.views)
        shared, moments = record_identity(head, settings.seed, identity, settings.recording, start)
        _write(partial / CANONICAL, shared.pop("canonical"))
        for moment in moments:
            _write(partial / moment.flame[0], moment.flame[1])
            for entry, files in moment.views:
                for kind, content in files.items():
                    _write(partial / entry[kind], content)
                _write(_note(partial, entry["timestep_index"], entry["camera_index"]), json.dumps(entry).encode())
                bar.add(1)
        entries = [json.loads(note.read_text()) for note in sorted((partial / _NOTES).iterdir())]
        shutil.rmtree(partial / _NOTES)
        _write(partial / "transforms.json", json.dumps({**shared, "frames": entries}, indent=1).encode())
        partial.replace(folder)
    if settings.archives:
        write_shard(shard, _entries(folder, name))
        write_index(shard, open_index(shard))


def _record(shard: Path, identity: int, settings: Synthesis, head: HeadModel, bar: _Bar) -> None:
    """Write a person's shard as it is rendered."""
    name = identity_name(identity)
    with ShardWriter(shard, "json") as writer:
        images = {name.partition(".")[0] for name, _, _ in writer.entries[_HEADER:]}
        size = (len(writer.entries) - _HEADER) // max(1, len(images))  # entries of an image
        start = len(images) // settings.views
        writer.keep(_HEADER + start * settings.views * size if images else 0)
        bar.skip(start * settings.views)
        shared, moments = record_identity(head, settings.seed, identity, settings.recording, start)
        if not images:
            writer.add(f"{name}.canonical.npz", shared.pop("canonical"))
            writer.add(f"{name}.json", json.dumps(shared).encode())
        for moment in moments:
            for entry, files in moment.views:
                for part in shard_entries(name, entry, {**files, "flame_param_path": moment.flame[1]}):
                    writer.add(*part)
                bar.add(1)
            writer.flush()
        writer.finish()


def _complete_moments(partial: Path, settings: Synthesis) -> int:
    """Moments of an unfinished capture that need not be made again: all but the last one, which may be torn."""
    last = settings.views - 1
    done = 0
    while done < settings.frames and _note(partial, done, last).is_file():
        done += 1
    return max(0, done - 1)


def _note(partial: Path, moment: int, view: int) -> Path:
    """Where the description of an image waits until all are there; it is written after the image's files."""
    return partial / _NOTES / f"{moment:06d}_{view:02d}.json"


def _write(target: Path, content: bytes) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(content)


def _complete(root: Path, identity: int, settings: Synthesis) -> bool:
    name = identity_name(identity)
    archived = not settings.archives or (root / "shards" / f"{name}.tar").exists()
    return archived and (not settings.captures or (root / "captures" / name).exists())


def _entries(folder: Path, name: str) -> Iterator[tuple[str, bytes]]:
    """Entries of the shard of one person: what all samples share first, then the samples."""
    description = json.loads((folder / "transforms.json").read_text())
    frames = description.pop("frames")
    yield f"{name}.canonical.npz", (folder / CANONICAL).read_bytes()
    yield f"{name}.json", json.dumps(description).encode()
    for entry in frames:
        yield from shard_entries(
            name, entry, {kind: (folder / entry[kind]).read_bytes() for kind in EXTENSIONS if kind in entry}
        )


def _agree(root: Path, settings: Synthesis, head: HeadModel) -> None:
    """Write the settings of a new set, or make sure that they are those of the set in the folder."""
    own = {name: getattr(settings, name) for name in ("views", "frames", "size", "seed")} | {"head_id": head.id}
    own |= {
        name: value
        for name, value in (("labels", settings.labels), ("images", settings.images))
        if value != _USUAL[name]
    }
    file = root / SETTINGS_FILE
    if not file.exists():
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(own, indent=1) + "\n")
        return
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise UikaError(f"{file}: cannot be read; remove it or choose another folder ({error})") from error
    if found != own:
        raise UikaError(f"{file}: the folder holds a set made with other values, {found}; choose another folder")


class _disk_errors:  # noqa: N801 - used like a function
    def __init__(self, root: Path) -> None:
        self._root = root

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, OSError):
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            reason = "the disk is full; free space" if full else f"writing failed ({error}); repair this"
            raise UikaError(f"{self._root}: {reason} and run the same command again to go on") from error


class _Bar:
    """Images done, with the time that is left; silent when not wanted."""

    def __init__(self, total: int, visible: bool) -> None:
        self._bar: Any = None
        if visible:
            try:
                from tqdm import tqdm
            except ImportError as error:
                raise UikaError(f"the progress bar needs tqdm; run: {install_command('tqdm')}") from error
            self._bar = tqdm(total=total, unit="image", desc="synthesize", smoothing=0.05)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def add(self, count: int) -> None:
        if self._bar is not None:
            self._bar.update(count)

    def skip(self, count: int) -> None:
        if self._bar is not None:
            # What is already there must not count as speed.
            self._bar.total -= count
            self._bar.refresh()


def _bar(total: int, visible: bool) -> _Bar:
    return _Bar(total, visible)
