"""Real spherical harmonics on Dr.Jit registers, plain or differentiable (the twin of `_harmonics`)."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ._harmonics import C1, C2, C3, C4
from .constants import SH_C0


def basis(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """The (degree + 1)^2 harmonics in the unit direction x, y, z; degree 0 to 4."""
    terms = [SH_C0 + 0 * x]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z, C2[2] * (xx - yy)]
    if degree >= 3:
        terms += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    if degree >= 4:
        terms += [
            C4[0] * x * y * (xx - yy),
            -C4[1] * y * z * (3 * xx - yy),
            C4[2] * x * y * (7 * zz - 1),
            -C4[3] * y * z * (7 * zz - 3),
            C4[4] * (zz * (35 * zz - 30) + 3),
            -C4[3] * x * z * (7 * zz - 3),
            C4[5] * (xx - yy) * (7 * zz - 1),
            -C4[1] * x * z * (xx - 3 * yy),
            C4[6] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return terms


def colors_seen_from(coefficients: Any, means: Any, viewmat: Any, degree: int) -> Any:
    """Colours [N, D] = max(0, 0.5 + SH) of coefficients [N, K, D] seen from the camera of `viewmat` [4, 4]."""
    kind = type(means)
    flat_type = dr.array_t(kind)
    index_type = dr.uint32_array_t(flat_type)
    n, stride, channels = coefficients.shape

    def entry(row: int, column: int) -> Any:
        # With the mode left to Dr.Jit 1.5.0, several threads now and then lose a gradient of so few entries.
        return dr.gather(flat_type, viewmat.array, index_type(4 * row + column), mode=dr.ReduceMode.Direct)

    def cross(a: list[Any], b: list[Any]) -> list[Any]:
        return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]

    rows = [[entry(r, k) for k in range(3)] for r in range(3)]
    normals = [cross(rows[(r + 1) % 3], rows[(r + 2) % 3]) for r in range(3)]
    determinant = sum(a * b for a, b in zip(rows[0], normals[0], strict=True))
    moved = [sum(entry(r, 3) * normals[r][k] for r in range(3)) / determinant for k in range(3)]
    scale = entry(3, 3) - sum(
        entry(3, k) * moved[k] for k in range(3)
    )  # 1, with the derivative of the matrix's inverse
    centre = [-value / scale for value in moved]

    i = dr.arange(index_type, n)
    away = [dr.gather(flat_type, means.array, 3 * i + k) - centre[k] for k in range(3)]
    inverse = dr.rsqrt(dr.maximum(away[0] * away[0] + away[1] * away[1] + away[2] * away[2], 1e-24))
    weights = basis(away[0] * inverse, away[1] * inverse, away[2] * inverse, degree)
    colors = dr.zeros(flat_type, n * channels)
    for channel in range(channels):
        value = flat_type(0.5)
        for k, weight in enumerate(weights):
            value = dr.fma(
                weight, dr.gather(flat_type, coefficients.array, (stride * i + k) * channels + channel), value
            )
        dr.scatter(colors, dr.select(value > 0, value, 0.0), channels * i + channel)
    return kind(colors, (n, channels))
