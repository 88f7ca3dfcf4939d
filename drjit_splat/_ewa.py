"""EWA projection of one splat a lane: the arithmetic that the projection kernel and its adjoint share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import Backend, larger, smaller
from ._footprint import LOG2E
from ._settings import Settings


@dataclass(frozen=True)
class Shape:
    """A splat's extent in the world: a rotation and deviations, or a covariance."""

    quat: list[Any]
    scale: list[Any]
    covariance: list[Any]  # the 9 entries, averaged across the diagonal


@dataclass(frozen=True)
class Camera:
    """One pinhole camera as Dr.Jit registers; sizes and limits are opaque so that kernels are reused."""

    view: list[Any]  # 12: rows of the world-to-camera matrix
    intrinsics: list[Any]  # fx, fy, cx, cy
    width: Any
    height: Any
    near: Any
    far: Any
    eps2d: Any
    radius_clip: Any


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
    opacity: Any  # after the antialiasing factor
    factor: Any | None
    in_range: Any
    invertible: Any

    def geometry(self) -> list[Any]:
        """x, y, a, h, d and log2(opacity) of log2(alpha) = log2(opacity) - (a (dx + h dy)^2 + d dy^2).

        A sum of squares, unlike the expanded quadratic, cannot turn negative by rounding far along a needle.
        """
        log_opacity = dr.log2(larger(self.opacity, c.OPACITY_FLOOR))
        half = 0.5 * LOG2E
        return [self.x, self.y, half * self.yy / self.determinant, -self.xy / self.yy, half / self.yy, log_opacity]


def _spread(shape: Shape, top: list[Any], low: list[Any]) -> tuple[Any, Any, Any, Any]:
    """Variances xx, xy, yy along the image axes `top` and `low` (rows of the Jacobian), and their determinant."""
    normal = [top[i] * low[j] - top[j] * low[i] for i, j in ((1, 2), (2, 0), (0, 1))]
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
        return larger(form(top, rows, top), 0.0), form(top, rows, low), larger(form(low, rows, low), 0.0), sharp
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
    a = [s * (top[0] * m[0] + top[1] * m[1] + top[2] * m[2]) for s, m in zip(shape.scale, columns, strict=True)]
    b = [s * (low[0] * m[0] + low[1] * m[1] + low[2] * m[2]) for s, m in zip(shape.scale, columns, strict=True)]
    xx = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    xy = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    yy = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    # A sum of squared minors: the difference xx * yy - xy^2 cancels for needles.
    minors = [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    return xx, xy, yy, minors[0] * minors[0] + minors[1] * minors[1] + minors[2] * minors[2]


def project(mean: list[Any], shape: Shape, opacity: Any, cam: Camera, settings: Settings) -> Ellipse:
    """Project one splat a lane; works on plain and on differentiable registers."""
    v = cam.view
    fx, fy, cx, cy = cam.intrinsics
    px, py, pz = (
        dr.fma(v[r], mean[0], dr.fma(v[r + 1], mean[1], dr.fma(v[r + 2], mean[2], v[r + 3]))) for r in (0, 4, 8)
    )
    in_range = (pz > cam.near) & (pz < cam.far)
    inv_z = 1 / dr.select(in_range, pz, 1.0)
    u, w = px * inv_z, py * inv_z

    def clamped(slope: Any, focal: Any, centre: Any, size: Any) -> Any:
        half = 0.5 * size / focal
        if settings.inria:  # symmetric about the optical axis, wherever the image lies
            limit = (1 + c.FRUSTUM_MARGIN) * half
            return smaller(larger(slope, -limit), limit)
        margin = c.FRUSTUM_MARGIN * half
        return smaller(larger(slope, -centre / focal - margin), (size - centre) / focal + margin)

    cu, cw = clamped(u, fx, cx, cam.width), clamped(w, fy, cy, cam.height)
    top = [fx * inv_z * (v[k] - cu * v[8 + k]) for k in range(3)]
    low = [fy * inv_z * (v[4 + k] - cw * v[8 + k]) for k in range(3)]
    xx, xy, yy, sharp = _spread(shape, top, low)
    determinant = sharp + cam.eps2d * (xx + yy) + cam.eps2d * cam.eps2d
    invertible = (determinant > c.DET_MIN) & (determinant < c.DET_MAX)
    determinant = dr.select(invertible, determinant, 1.0)
    factor = dr.sqrt(larger(sharp / determinant, c.COMPENSATION_MIN)) if settings.antialiased else None
    return Ellipse(
        dr.fma(fx, u, cx),
        dr.fma(fy, w, cy),
        pz,
        xx + cam.eps2d,
        xy,
        yy + cam.eps2d,
        determinant,
        opacity if factor is None else opacity * factor,
        factor,
        in_range,
        invertible,
    )


def exact_centre(be: Backend, mean: list[Any], cam: Camera) -> list[Any]:
    """Projected mean relative to the middle of the image (pixels), by way of float64.

    Rounding x and z to float32 before they are divided moves splats by 1e-5 pixels, which is most of an image's error.
    """
    J = be.plain
    x, y, z = (J.Float64(v) for v in mean)
    rows = [[J.Float64(v) for v in cam.view[r : r + 4]] for r in (0, 4, 8)]
    px, py, pz = (dr.fma(v[0], x, dr.fma(v[1], y, dr.fma(v[2], z, v[3]))) for v in rows)
    inverse = 1 / dr.select((J.Float(pz) > cam.near) & (J.Float(pz) < cam.far), pz, 1.0)
    fx, fy, cx, cy = (J.Float64(v) for v in cam.intrinsics)
    width, height = J.Float64(cam.width), J.Float64(cam.height)
    return [J.Float(dr.fma(fx * px, inverse, cx - 0.5 * width)), J.Float(dr.fma(fy * py, inverse, cy - 0.5 * height))]
