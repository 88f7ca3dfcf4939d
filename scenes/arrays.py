"""Handing arrays to Dr.Jit."""

from __future__ import annotations

import numpy as np

_ALIGNMENT = 64  # bytes, of the widest vector registers


def aligned(array: np.ndarray) -> np.ndarray:
    """A copy, contiguous and aligned for vector instructions.

    Dr.Jit adopts NumPy's memory and compiles another kernel where it starts at an odd place, which is up to chance.
    """
    buffer = np.empty(array.nbytes + _ALIGNMENT, np.uint8)
    start = -buffer.ctypes.data % _ALIGNMENT
    result = buffer[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    result[...] = array
    return result


def flat(array: np.ndarray) -> np.ndarray:
    """`aligned`, without its shape."""
    return aligned(array).ravel()
