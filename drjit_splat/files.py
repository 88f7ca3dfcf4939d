"""Splat files of any kind by the ending of their name."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from .ply import SplatFile, load_ply
from .sog import load_sog
from .splat import load_splat
from .spz import load_spz

LOADERS: dict[str, Callable[[str | os.PathLike[str]], SplatFile]] = {
    ".ply": load_ply,
    ".sog": load_sog,
    ".splat": load_splat,
    ".spz": load_spz,
}


def load_splats(path: str | os.PathLike[str]) -> SplatFile:
    """Read a `.ply` (plain or compressed), `.spz`, `.sog` or `.splat` file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: its name has another ending, or it cannot be used; the message names it.
    """
    loader = LOADERS.get(Path(path).suffix.lower())
    if loader is None:
        raise ValueError(f"{path}: splat files end in {', '.join(LOADERS)}")
    return loader(path)
