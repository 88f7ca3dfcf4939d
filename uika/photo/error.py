"""The one error the photo room raises."""

from __future__ import annotations

from pathlib import Path


class PhotoError(ValueError):
    """A photo that cannot be used; the message is one sentence that names the file and says what to do."""

    def __init__(self, path: str | Path, problem: str) -> None:
        """Name the file and say what is wrong with it and what to do."""
        super().__init__(f"{path}: {problem}")
        self.path = str(path)
