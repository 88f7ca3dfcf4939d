"""Opening films and sound files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_PLAYLISTS = {"concat", "hls", "applehttp", "dash", "imf"}  # FFmpeg's names; they may lead anywhere


def open_media(path: Path) -> Any:
    """An opened film or sound (PyAV's container); what is not text in its metadata does not keep it from being read.

    Raises:
        ValueError: the file only lists others.
        av.FFmpegError, OSError: it cannot be opened.
    """
    import av

    try:
        container = av.open(str(path), metadata_errors="replace")
    except TypeError:  # newer versions of PyAV replace by themselves
        container = av.open(str(path))
    if set(container.format.name.split(",")) & _PLAYLISTS:
        container.close()
        raise ValueError("is a list of other files; give the film or sound itself")
    return container
