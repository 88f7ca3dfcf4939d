"""Radiance pictures (.hdr): linear light as mantissas that share an exponent (RGBE), run-length coded or not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uika.errors import UikaError

_MAX_SIDE = 16384
_MAX_PIXELS = 1 << 27  # 16384 x 8192
_MOST_PACKED = 64  # times that run lengths make a row smaller


def read_hdr(path: str | Path) -> NDArray[np.float32]:
    """The linear radiance [H,W,3] of a .hdr file whose rows run from top to bottom.

    Raises:
        UikaError: there is no such file, it is no Radiance picture of that kind, or it is cut short; names the file.
    """
    source = Path(path)
    if not source.is_file():
        raise UikaError(f"{source}: no such file; give a Radiance picture (.hdr)")
    data = source.read_bytes()
    head = re.match(rb"#\?(?:RADIANCE|RGBE)\n(?:[^\n]+\n)*?\n-Y (\d+) \+X (\d+)\n", data)
    if head is None or b"FORMAT=32-bit_rle_rgbe" not in head[0]:
        raise UikaError(f"{source}: is not a Radiance picture (.hdr, 32-bit_rle_rgbe, -Y +X); convert it to one")
    height, width = int(head[1]), int(head[2])
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE):
        raise UikaError(f"{source}: is {width}x{height} pixels; sides of 1 to {_MAX_SIDE} can be read")
    if height * width > _MAX_PIXELS:
        raise UikaError(f"{source}: is {width}x{height} pixels; {_MAX_PIXELS >> 20} million are the most")
    body = np.frombuffer(data, np.uint8, offset=head.end())
    try:
        if height * width * 4 > _MOST_PACKED * len(body):
            raise ValueError("size")
        rows = _coded(body, height, width) if body[:2].tolist() == [2, 2] else body[: height * width * 4]
        pixels = rows.reshape(height, width, 4)
    except (IndexError, ValueError) as error:
        raise UikaError(f"{source}: is cut short or damaged; fetch it again") from error
    scale = np.ldexp(np.float32(1), pixels[..., 3:].astype(np.int16) - 136) * (pixels[..., 3:] > 0)
    return np.asarray(pixels[..., :3] * scale, dtype=np.float32)


def _coded(body: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Rows of run-length coded planes: a count above 128 repeats the next byte, one below copies as many."""
    result = np.empty((height, width, 4), np.uint8)
    at = 0
    for row in range(height):
        if body[at : at + 4].tolist() != [2, 2, width >> 8, width & 255]:
            raise ValueError("row")
        at += 4
        for channel in range(4):
            column = 0
            while column < width:
                count = int(body[at])
                run = count - 128 if count > 128 else count
                if run == 0 or column + run > width:
                    raise ValueError("run")
                values = body[at + 1 : at + 2] if count > 128 else body[at + 1 : at + 1 + run]
                result[row, column : column + run, channel] = values
                at += 2 if count > 128 else 1 + run
                column += run
    return result
