"""Text files as programs on any system write them."""

from __future__ import annotations

import codecs
from pathlib import Path

MAX_BYTES = 1 << 28
_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def read_text(path: Path) -> str:
    """The text of a file: UTF-8, or what its byte order mark says.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no text or has more than 256 MiB.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES >> 20} MiB")
    data = path.read_bytes()
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "utf-8")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        raise ValueError(f"no UTF-8 text, from byte {error.start} on; save it as UTF-8") from error
