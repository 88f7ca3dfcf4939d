"""Checks of camera matrices, shared by the torch and the Dr.Jit interface."""

from __future__ import annotations

from typing import Any

import numpy as np

_SLACK = 1e-5  # of a matrix's last row: what inverting it in float32 may leave


def check_cameras(viewmats: Any, Ks: Any) -> None:
    """Check finite viewmats [..., C, 4, 4] and Ks [..., C, 3, 3].

    Raises:
        ValueError: a matrix is not what the projection takes it for; the message names it.
    """
    last = np.asarray(viewmats, dtype=np.float64)[..., 3, :]
    for index in np.argwhere((np.abs(last - (0, 0, 0, 1)) > _SLACK).any(-1)).tolist():
        raise ValueError(
            f"viewmats{index} must end in the row 0, 0, 0, 1, not {', '.join(f'{v:g}' for v in last[tuple(index)])}; "
            "is it transposed?"
        )
    Ks = np.asarray(Ks, dtype=np.float64)
    for place in np.ndindex(Ks.shape[:-2]):
        K, name = Ks[place].tolist(), f"Ks{list(place)}"
        if K[0][0] <= 0 or K[1][1] <= 0:
            raise ValueError(f"{name} must have positive focal lengths, not {K[0][0]} and {K[1][1]}")
        if K[0][1] != 0 or K[1][0] != 0 or K[2] != [0, 0, 1]:
            raise ValueError(
                f"{name} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew ({K[0][1]}) is refused because other"
                " rasterizers ignore it silently"
            )
