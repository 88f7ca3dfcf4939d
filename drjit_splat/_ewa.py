"""EWA projection of one splat a lane: the arithmetic that the projection kernel and its adjoint share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import larger
from ._lens import Camera, see
from ._settings import Settings


@dataclass(frozen=True)
class Shape:
    """A splat's extent in the world: a rotation and deviations, or a covariance."""

    quat: list[Any]
    scale: list[Any]
    covariance: list[Any]  # the 9 entries, averaged across the diagonal


@dataclass(frozen=True)
class Ellipse:
    """A splat on the image plane."""

    x: Any
    y: Any
    z: Any
    xx: Any
    xy: Any
    yy: Any
    determinant: Any
    sharpness: Any  # log2(e) yy / (2 determinant), of the variance along x where y is held
    lean: Any  # -xy / yy
    opacity: Any  # after the antialiasing factor
    factor: Any | None
    in_range: Any
    invertible: Any

    def geometry(self) -> list[Any]:
        """x, y, a, h, d and log2(opacity) of log2(alpha) = log2(opacity) - (a (dx + h dy)^2 + d dy^2).

        A sum of squares, unlike the expanded quadratic, cannot turn negative by rounding far along a needle.
        """
        log_opacity = dr.log2(larger(self.opacity, c.OPACITY_FLOOR))
        half = 0.5 * c.LOG2E
        return [self.x, self.y, self.sharpness, self.lean, half / self.yy, log_opacity]


@dataclass(frozen=True)
class Spread:
    """A splat's extent along the image axes before the low-pass."""

    xx: Any
    xy: Any
    yy: Any
    sharp: Any  # xx * yy - xy^2
    a: list[Any]  # the splat's axes along x and y: xx = a.a, xy = a.b, yy = b.b; none of a covariance
    b: list[Any]
    minors: list[Any]  # a x b


def _dot(u: Sequence[Any], v: Sequence[Any]) -> Any:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u: list[Any], v: list[Any]) -> list[Any]:
    return [u[i] * v[j] - u[j] * v[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def _spread(shape: Shape, top: list[Any], low: list[Any]) -> Spread:
    """Variances along the image axes `top` and `low` (rows of the Jacobian)."""
    normal = _cross(top, low)
    if shape.covariance:
        m = shape.covariance
        xx, xy, _, _, yy, yz, _, _, zz = m
        xy, xz, yz = 0.5 * (xy + m[3]), 0.5 * (m[2] + m[6]), 0.5 * (yz + m[7])
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        # The determinant of J S J^T is n^T adj(S) n with n the cross product of J's rows.
        adjugate = (
            (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy),
            (xz * yz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
            (xy * yz - xz * yy, xy * xz - xx * yz, xx * yy - xy * xy),
        )

        def form(u: list[Any], matrix: Any, v: list[Any]) -> Any:
            return sum(u[r] * (matrix[r][0] * v[0] + matrix[r][1] * v[1] + matrix[r][2] * v[2]) for r in range(3))

        sharp = larger(form(normal, adjugate, normal), 0.0)
        xx, yy = larger(form(top, rows, top), 0.0), larger(form(low, rows, low), 0.0)
        return Spread(xx, form(top, rows, low), yy, sharp, [], [], [])
    squared = sum(q * q for q in shape.quat)
    usable = squared >= c.QUAT_MIN_NORM**2
    inv_norm = 1 / dr.sqrt(dr.select(usable, squared, 1.0))
    qw = dr.select(usable, shape.quat[0] * inv_norm, 1.0)
    qx, qy, qz = (dr.select(usable, q * inv_norm, 0.0) for q in shape.quat[1:])
    columns = (
        (1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy)),
        (2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx)),
        (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy)),
    )
    a = [s * _dot(top, m) for s, m in zip(shape.scale, columns, strict=True)]
    b = [s * _dot(low, m) for s, m in zip(shape.scale, columns, strict=True)]
    # A sum of squared minors: the difference xx * yy - xy^2 cancels for needles.
    minors = _cross(a, b)
    return Spread(_dot(a, a), _dot(a, b), _dot(b, b), _dot(minors, minors), a, b, minors)


def _sheared(spread: Spread, yy: Any, determinant: Any, eps2d: Any) -> tuple[Any, Any]:
    """log2(e) yy / (2 determinant) and h = -xy / yy, with derivatives that keep their digits for splats of any length.

    determinant / yy is the least |a + h b|^2 + eps2d (1 + h^2), so only the residual r = a + h b = (b x (a x b)
    + eps2d a) / yy takes part in its derivative 2 r.(da + h db), and that of h is -(b.(da + h db) + r.db) / yy. The
    quotients' own derivatives are differences of terms that grow with the splat and all but cancel, over yy^2, which
    leaves the range of float32.
    """
    value, h = 0.5 * c.LOG2E * yy / determinant, -spread.xy / yy
    if not spread.a or not dr.is_diff_v(value):
        return value, h
    a, b, minors, plain_yy, slope = (dr.detach(v, True) for v in (spread.a, spread.b, spread.minors, yy, h))
    turned = _cross(b, minors)
    residual = [(t + dr.detach(eps2d) * u) / plain_yy for t, u in zip(turned, a, strict=True)]
    factor = dr.detach(-2.0 * value * yy / determinant)
    moved = [u + slope * v for u, v in zip(spread.a, spread.b, strict=True)]
    lean = _dot([v / plain_yy for v in b], moved) + _dot([r / plain_yy for r in residual], spread.b)
    replace: Any = dr.replace_grad  # its type says that it returns nothing
    return replace(value, factor * _dot(residual, moved)), replace(h, -lean)


def _compensation(spread: Spread, low_pass: Any, determinant: Any) -> Any:
    """sqrt(sharp / (sharp + low_pass)), written so that large splats, whose factor is 1, get no derivative of noise."""
    usable = spread.sharp > c.COMPENSATION_MIN * determinant
    ratio = low_pass / dr.select(usable, spread.sharp, 1.0)
    return dr.select(usable, 1 / dr.sqrt(1 + ratio), math.sqrt(c.COMPENSATION_MIN))


def project(mean: list[Any], shape: Shape, opacity: Any, cam: Camera, settings: Settings) -> Ellipse:
    """Project one splat a lane; works on plain and on differentiable registers."""
    v = cam.view
    point = [dr.fma(v[r], mean[0], dr.fma(v[r + 1], mean[1], dr.fma(v[r + 2], mean[2], v[r + 3]))) for r in (0, 4, 8)]
    seen = see(point, cam, settings)
    spread = _spread(shape, seen.top, seen.low)
    low_pass = cam.eps2d * (spread.xx + spread.yy) + cam.eps2d * cam.eps2d
    determinant = spread.sharp + low_pass
    invertible = (determinant > c.DET_MIN) & (determinant < c.DET_MAX)
    determinant = dr.select(invertible, determinant, 1.0)
    factor = _compensation(spread, low_pass, determinant) if settings.antialiased else None
    xx, yy = spread.xx + cam.eps2d, spread.yy + cam.eps2d
    return Ellipse(
        seen.x,
        seen.y,
        point[2],
        xx,
        spread.xy,
        yy,
        determinant,
        *_sheared(spread, yy, determinant, cam.eps2d),
        opacity if factor is None else opacity * factor,
        factor,
        seen.in_range,
        invertible,
    )
