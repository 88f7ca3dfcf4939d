"""Progress bars on stderr."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

from uika.errors import UikaError, install_command

Item = TypeVar("Item")


def counted(items: Iterable[Item], progress: bool, total: int | None, name: str) -> Iterable[Item]:
    """The same items, with a bar that counts them if `progress` asks for one.

    Raises:
        UikaError: a bar is asked for and tqdm is missing.
    """
    if not progress:
        return items
    try:
        from tqdm import tqdm
    except ModuleNotFoundError as error:
        raise UikaError(f"the progress bar needs tqdm; run: {install_command('tqdm')}") from error
    bar: Iterable[Item] = tqdm(items, total=total, desc=name, unit="frame", leave=False)
    return bar


def counted(count: int, progress: bool) -> Iterable[int]:
    """The numbers of the frames, with a progress bar on stderr if asked for."""
    if not progress:
        return range(count)
    try:
        from tqdm import tqdm
    except ModuleNotFoundError as error:
        raise UikaError(f"the progress bar needs tqdm; run: {install_command('tqdm')}") from error
    bar: Any = tqdm(range(count), desc="frames", unit="frame", leave=False, disable=None)
    return bar
