"""The focal length that a camera wrote into its photo."""

from __future__ import annotations

import math
from typing import Any

_EXIF, _WIDTH, _HEIGHT, _FOCAL_35MM = 0x8769, 0xA002, 0xA003, 0xA405
_DIAGONAL_35MM = 43.27  # millimetres; equivalent focal lengths compare diagonals (CIPA DCG-001)
_SHORTEST, _LONGEST = 8, 1200  # millimetres
_SENSORS = (4 / 3, 3 / 2, 16 / 9)
_SAME_ASPECT = 0.01


def focal_length(image: Any) -> float | None:
    """Pixels of the focal length of an opened Pillow image, or None where it does not say or was cropped since.

    Programs that crop a photo keep the lens's entry, which then is wrong: the sides must be in the proportion of those
    that the camera noted, or, if it noted none, in a sensor's.
    """
    try:
        entries = image.getexif().get_ifd(_EXIF)
        millimetres, noted = float(entries.get(_FOCAL_35MM, 0)), (entries.get(_WIDTH, 0), entries.get(_HEIGHT, 0))
        sides = sorted(float(side) for side in noted)
    except Exception:  # hostile bytes meet Pillow's reader with many exception types; the pixels decide about the file
        return None
    if not _SHORTEST <= millimetres <= _LONGEST:
        return None
    short, long = sorted(image.size)
    aspects = (sides[1] / sides[0],) if sides[0] > 0 else _SENSORS
    if not any(abs(long / short / aspect - 1) < _SAME_ASPECT for aspect in aspects):
        return None
    return millimetres / _DIAGONAL_35MM * math.hypot(short, long)
