"""Progress bars on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
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


@contextmanager
def steps() -> Iterator[Callable[[str], None]]:
    """What the steps of a piece of work are told to: one line on a terminal's stderr that each rewrites.

    Elsewhere, in a log say, each step gets a line of its own.
    """
    terminal, start = sys.stderr.isatty(), time.monotonic()

    def say(step: str) -> None:
        text = f"{step} ... ({time.monotonic() - start:.1f} s)" if terminal else f"{step} ..."
        print(f"\r\x1b[K{text}" if terminal else text, end="" if terminal else "\n", file=sys.stderr, flush=True)

    try:
        yield say
    finally:
        if terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
