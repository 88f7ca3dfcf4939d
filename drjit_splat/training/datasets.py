"""Opening a data set, whatever program wrote it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from .captures import Capture, is_there
from .colmap import colmap_folder, read_colmap
from .transforms import read_blender, read_transforms


def open_capture(path: str | Path, every: int = 8) -> Capture:
    """Read a data set.

    Args:
        path: a COLMAP folder (`sparse/0` or the tables themselves, beside `images`), a `transforms.json` of
            nerfstudio or its folder, or a folder of NeRF-synthetic with `transforms_train.json`.
        every: each so many-th photo is held out, where the data set does not say which are.

    Raises:
        ValueError: there is no data set, or it cannot be used; the message names the file.
    """
    place = Path(path)
    if every < 2:
        raise ValueError(f"every: must be at least 2, not {every}")
    if not place.exists():
        raise ValueError(f"{place}: no such data set")
    if place.is_file() or (place / "transforms.json").is_file():
        return _split(read_transforms(place if place.is_file() else place / "transforms.json"), every, place)
    if (place / "transforms_train.json").is_file():
        return _checked(read_blender(place), place)
    if (tables := colmap_folder(place)) is not None:
        return _split(read_colmap(place, tables), every, place)
    raise ValueError(
        f"{place}: holds neither transforms.json, transforms_train.json nor COLMAP tables (cameras, images, points3D)"
    )


def _split(capture: Capture, every: int, place: Path) -> Capture:
    photos = sorted(capture.photos, key=lambda photo: photo.path)
    held_out = tuple(photos[::every]) if len(photos) >= every else ()
    return _checked(
        replace(capture, photos=tuple(p for i, p in enumerate(photos) if i % every or not held_out), held_out=held_out),
        place,
    )


def _checked(capture: Capture, place: Path) -> Capture:
    """The capture, if it has photos and their files are there."""
    if not capture.photos:
        raise ValueError(f"{place}: the data set has no photos with poses")
    missing = [photo.path for photo in (*capture.photos, *capture.held_out) if not is_there(photo.path)]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ValueError(f"{missing[0]}: the data set {place} names this picture, which is not there{more}")
    return capture
