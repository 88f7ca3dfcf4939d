"""Opening films and sound files."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def open_media(path: Path) -> Any:
    """An opened film or sound (PyAV's container); what is not text in its metadata does not keep it from being read."""
    import av

    try:
        return av.open(str(path), metadata_errors="replace")
    except TypeError:  # newer versions of PyAV replace by themselves
        return av.open(str(path))
