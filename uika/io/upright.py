"""Frames of a video as a player shows them: turned and stretched by what the file says about the picture."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MOST_STRETCHED = 4  # times; broken files claim pixels a thousand times as wide as high


def shown_width(frame: Any, aspect: Fraction | None) -> int:
    """The width at which pixels of this aspect (width over height) are square."""
    if not aspect or not 1 / _MOST_STRETCHED <= aspect <= _MOST_STRETCHED:
        return int(frame.width)
    return max(1, round(frame.width * aspect))


def upright(picture: NDArray[np.uint8], frame: Any) -> NDArray[np.uint8]:
    """The picture [H,W,...] of a decoded frame (PyAV's) turned and mirrored as the file's display matrix says.

    Only quarter turns are made; a player would show other angles with empty corners, which no camera writes.
    """
    try:
        matrix = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # among what the frame brings is something newer than PyAV
        return np.ascontiguousarray(np.rot90(picture, round(frame.rotation / 90)))
    if matrix is None or matrix.buffer_size < 36:
        return picture
    a, b, _, c, d = struct.unpack("<5i", bytes(matrix)[:20])
    # The point (p, q) of the stored picture is shown at (a p + c q, b p + d q).
    if abs(b) > abs(a):
        picture, across, down = picture.swapaxes(0, 1), c, b
    else:
        across, down = a, d
    return np.ascontiguousarray(picture[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])
