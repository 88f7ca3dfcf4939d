"""Shards: tar files in the layout of webdataset, written whole and always the same way."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uika.data.capture import parse_frame
from uika.data.decoding import build_sample, read_arrays
from uika.data.sample import DataError, Sample
from uika.io.files import replacing

# Key of a frame's description -> extension of its file in a shard; pictures may have others, see `PICTURES`.
EXTENSIONS = {
    "file_path": "png",
    "fg_mask_path": "mask.png",
    "uv_path": "uv.png",
    "depth_path": "depth.png",
    "flame_param_path": "flame.npz",
}
PICTURES = ("png", "jpg")


def shard_entries(name: str, entry: dict[str, Any], files: Mapping[str, bytes]) -> Iterator[tuple[str, bytes]]:
    """Entries of one image of a person `name`: its files, the description last.

    Args:
        name: of the person.
        entry: the image's description.
        files: key of the description -> content of the file that it names.
    """
    key = f"{name}_{entry['timestep_index']:05d}_{entry['camera_id']}"
    for kind, extension in EXTENSIONS.items():
        if kind in files:
            own = entry[kind].rpartition(".")[2] if kind == "file_path" else extension
            yield f"{key}.{own}", files[kind]
    yield f"{key}.json", json.dumps(entry).encode()


def picture_files(key: str, extensions: Collection[str]) -> dict[str, str]:
    """Key of a description -> name of the entry, for the extensions that a group of a shard has; empty: no image."""
    picture = next((extension for extension in PICTURES if extension in extensions), None)
    if picture is None:
        return {}
    own = EXTENSIONS | {"file_path": picture}
    return {kind: f"{key}.{extension}" for kind, extension in own.items() if extension in extensions}


def write_shard(path: str | Path, entries: Iterable[tuple[str, bytes]]) -> None:
    """Write named entries; the file appears whole or not at all, and the same entries give the same bytes."""
    with replacing(path) as temporary, tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in entries:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))


def read_shard(path: str | Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Groups of entries that share the name before the first dot: (key, extension -> content), in the file's order.

    Raises:
        DataError: the file is missing, damaged or truncated; the message names it.
    """
    source = Path(path)
    key = ""
    group: dict[str, bytes] = {}
    try:
        size = source.stat().st_size
        with tarfile.open(source, "r:") as archive:
            for info in archive:
                if info.issparse() or info.size > size:
                    raise DataError(f"{source}: promises more than it holds; make it again")
                stem, _, extension = info.name.partition(".")
                handle = archive.extractfile(info) if info.isfile() else None
                if handle is None:
                    continue
                if stem != key and group:
                    yield key, group
                    group = {}
                key = stem
                group[extension] = handle.read()
                if len(group[extension]) != info.size:
                    raise DataError(f"{source}: is truncated; make it again")
    except DataError:
        raise
    except (OSError, EOFError, ValueError, OverflowError, tarfile.TarError) as error:
        raise DataError(f"{source}: is not a readable shard ({error})") from error
    if group:
        yield key, group


def shard_samples(path: str | Path, strict: bool = False) -> Iterator[Sample]:
    """The samples of a shard that `uika.data.synthesize` wrote; bad ones are left out unless `strict`.

    Raises:
        DataError: the shard is damaged, or, with `strict`, one of its samples.
    """
    canonical: dict[str, np.ndarray] = {}
    for key, group in read_shard(path):
        try:
            if "canonical.npz" in group:
                canonical = read_arrays(group["canonical.npz"], f"{path}/{key}.canonical.npz")
                continue
            yield _sample(key, group, canonical, str(path))
        except DataError:
            if strict:
                raise


def _sample(key: str, group: dict[str, bytes], canonical: dict[str, np.ndarray], where: str) -> Sample:
    name = f"{where}/{key}.json"
    try:
        entry = json.loads(group["json"])
    except (KeyError, ValueError, RecursionError) as error:
        raise DataError(f"{name}: is missing or not complete JSON") from error
    files = picture_files(key, group)
    if not isinstance(entry, dict) or not files:
        raise DataError(f"{where}/{key}: lacks its image or description")
    contents = {kind: group[file.partition(".")[2]] for kind, file in files.items()}
    return build_sample(parse_frame(entry, files, name, 0), contents, canonical, where, key.partition("_")[0])
