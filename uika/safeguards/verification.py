"""Reading provenance and watermark back from files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.errors import UikaError
from uika.io.media import open_media
from uika.io.npz import ArraysError, read_npz
from uika.safeguards.provenance import as_text
from uika.safeguards.watermark import Detection, detect

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
VIDEOS = (".mp4", ".mov", ".mkv", ".webm")
DATA = (".safetensors", ".glb", ".ply", ".html", ".npz")
_FRAMES = 12  # of a video that are looked at
_MAX_PIXELS = 36_000_000  # a picture of 8K fits
_PIXELS_KEPT = 64_000_000  # of all frames that are looked at together
_KEY = "provenance"
_HEADER = 1 << 16


@dataclass(frozen=True)
class Finding:
    """What a file says about itself."""

    provenance: Mapping[str, str]  # empty if it has none
    watermark: Detection | None  # None for files that are no pictures

    @property
    def found(self) -> bool:
        """Whether there is any sign that this program made the file."""
        return bool(self.provenance) or (self.watermark is not None and self.watermark.found)


def verify(path: str | Path) -> Finding:
    """Look for provenance and, in pictures and videos, for the watermark.

    Args:
        path: .png, .jpg, .webp, .mp4, .mov, .mkv, .webm, .safetensors, .glb, .ply, .html or .npz file.

    Raises:
        UikaError: no such file, another kind of file, or one that cannot be read; it names the file.
    """
    source = Path(path)
    kind = source.suffix.lower()
    if not source.is_file():
        raise UikaError(f"{source}: {'is a directory' if source.is_dir() else 'no such file'}; give one file to verify")
    if kind in PICTURES:
        return _picture(source)
    if kind in VIDEOS:
        return _video(source)
    if kind in DATA:
        return Finding(_data(source, kind), None)
    raise UikaError(f"{source}: cannot be verified; give a file that ends in {', '.join((*PICTURES, *VIDEOS, *DATA))}")


def _picture(path: Path) -> Finding:
    from PIL import Image

    try:
        with Image.open(path) as picture:
            _check_size(path, picture.width, picture.height)
            text = picture.info.get(_KEY) or picture.info.get("comment") or ""
            rgb = torch.from_numpy(np.array(picture.convert("RGB"))).float().div_(255)
    except UikaError:
        raise
    except Exception as error:  # decoders meet hostile bytes with many exception types
        raise UikaError(f"{path}: is no picture that can be read ({error})") from error
    if isinstance(text, bytes):
        text = text.decode("utf-8", "replace")
    return Finding(_parsed(text), detect([rgb]))


def _video(path: Path) -> Finding:
    import av

    try:
        with open_media(path) as container:
            text = container.metadata.get("comment") or container.metadata.get("COMMENT") or ""
            frames = _spread(path, container)
    except UikaError:
        raise
    except (av.FFmpegError, OSError, ValueError) as error:
        raise UikaError(f"{path}: is no video that can be read ({error})") from error
    if not frames:
        raise UikaError(f"{path}: has no pictures")
    return Finding(_parsed(text), detect(frame.float().div_(255) for frame in frames))


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > _MAX_PIXELS:
        raise UikaError(f"{path}: has {width}x{height} pixels; {_MAX_PIXELS:,} are the most")


def _spread(path: Path, container: Any) -> list[Tensor]:
    """Some frames [H,W,3] of 8 bits from the whole of a video, the first among them."""
    if not container.streams.video:
        return []
    kept: list[Tensor] = []
    step = 1
    for index, frame in enumerate(container.decode(video=0)):
        if index % step:
            continue
        _check_size(path, frame.width, frame.height)
        kept.append(torch.from_numpy(frame.to_ndarray(format="rgb24")))
        most = max(2, min(2 * _FRAMES, _PIXELS_KEPT // (frame.width * frame.height)))
        if len(kept) >= most:  # a video's length is only known at its end
            kept, step = kept[::2], 2 * step
    return kept[:: max(1, len(kept) // _FRAMES)]


def _data(path: Path, kind: str) -> Mapping[str, str]:
    if kind == ".glb":
        from uika.export import glb_provenance

        return glb_provenance(path)
    if kind == ".html":
        from uika.export import html_provenance

        return html_provenance(path)
    if kind == ".ply":
        return _comments(path)
    if kind == ".npz":
        return _array(path)
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            return _parsed((file.metadata() or {}).get(_KEY, ""))
    except SafetensorError as error:
        raise UikaError(f"{path}: is damaged or no safetensors file ({error})") from error


def _array(path: Path) -> Mapping[str, str]:
    try:
        found = read_npz(path, (_KEY,)).get(_KEY)
    except ArraysError as error:
        raise UikaError(f"{path}: is damaged or no .npz file ({error})") from error
    return {} if found is None else _parsed(str(found))


def _comments(path: Path) -> dict[str, str]:
    with path.open("rb") as file:
        head = file.read(_HEADER).split(b"end_header")[0].decode("ascii", "replace")
    if not head.startswith("ply"):
        raise UikaError(f"{path}: is no .ply file")
    lines = [line.removeprefix("comment ") for line in head.splitlines() if line.startswith("comment ")]
    return dict(line.split(": ", 1) for line in lines if ": " in line)


def _parsed(text: str) -> Mapping[str, str]:
    try:
        return as_text(json.loads(text))
    except (ValueError, RecursionError):
        return {}
