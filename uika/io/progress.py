"""Progress bars on stderr."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

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
    bar: Iterable[Item] = tqdm(items, total=total, desc=name, unit="frame", leave=False, disable=None)
    return bar
