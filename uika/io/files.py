"""Output files: checked before the work starts, and seen under their name only when they are complete."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from uika.errors import UikaError

if TYPE_CHECKING:
    from torch import Tensor


def check_output(path: str | Path, suffix: str) -> Path:
    """Refuse an output path that could not be written later.

    Args:
        path: the file to write; missing parent folders are fine, they are made when the file is written.
        suffix: the extension it must have, with the dot.

    Raises:
        UikaError: wrong extension, a directory, or a place where nothing can be written.
    """
    target = Path(path)
    if target.is_dir():
        raise UikaError(f"{target}: is a directory; give the name of a {suffix} file")
    if target.suffix.lower() != suffix:
        raise UikaError(f"{target}: the output's name must end in {suffix}")
    check_folder(target.parent)
    return target


def check_folder(path: str | Path) -> Path:
    """Refuse an output folder that neither exists nor can be made.

    Raises:
        UikaError: a part of the path is a file, or it may not be written to.
    """
    folder = Path(path)
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise UikaError(f"{folder}: cannot be made because {existing} is not a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise UikaError(f"{folder}: {existing} cannot be written to; choose another folder")
    return folder


def stands_for_another(path: Path) -> str:
    """What a download left in the place of a file: "a web page" or "a Git LFS pointer"; empty if neither."""
    with path.open("rb") as file:
        start = file.read(256).lstrip().lower()
    if start.startswith(b"version https://git-lfs"):
        return "a Git LFS pointer"
    return "a web page" if start.startswith((b"<!doctype html", b"<html", b"<?xml")) else ""


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` with its extension; renamed to `path` at the end, removed after an error.

    Raises:
        UikaError: nothing can be written there.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        raise UikaError(f"{target}: cannot be written ({error.strerror}); choose another place") from error
    try:
        mode = temporary.stat().st_mode & 0o777
        yield temporary
        temporary.chmod(mode)  # some writers make private files of their own
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def write_tensors(path: str | Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    """Write a safetensors file; it appears under its name only when it is complete.

    Raises:
        UikaError: it cannot be written, for example because the disk is full.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with replacing(path) as temporary:
        try:
            save_file(tensors, temporary, metadata=metadata)
        except SafetensorError as error:
            raise UikaError(f"{path}: cannot be written ({error})") from error
