"""Shards: tar files in the layout of webdataset, written whole and always the same way."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from uika.data.capture import parse_frame
from uika.data.decoding import build_sample, read_arrays
from uika.data.sample import DataError, Sample
from uika.io.files import replacing

# Key of a frame's description -> extension of its file in a shard.
EXTENSIONS = {
    "file_path": "png",
    "fg_mask_path": "mask.png",
    "uv_path": "uv.png",
    "depth_path": "depth.png",
    "flame_param_path": "flame.npz",
}


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
    if not isinstance(entry, dict) or "png" not in group:
        raise DataError(f"{where}/{key}: lacks its image or description")
    contents = {kind: group[extension] for kind, extension in EXTENSIONS.items() if extension in group}
    files = {kind: f"{key}.{EXTENSIONS[kind]}" for kind in contents}
    return build_sample(parse_frame(entry, files, name, 0), contents, canonical, where, key.partition("_")[0])
