"""EWA projection of splats: the arithmetic (shared with its adjoint) and the kernel that writes the records."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import Backend, bits_of, larger, packet, power_of_two, smaller, write, write_packet
from ._footprint import LOG2E, count_tiles, footprint, square_limits, square_radius
from ._settings import Settings

RECORD = 16  # floats a splat: 8 of geometry (see Ellipse.geometry; 2^-2a, 2^-2ah), then up to 8 features
CULLED = ("", "depth", "degenerate", "opacity", "offscreen", "radius_clip")
NONFINITE, BOX_PAIRS, PAIRS = 6, 7, 8  # further places of the tally


@dataclass(frozen=True)
class Arrays:
    """The inputs of one image as flat, plain Dr.Jit float32 arrays."""

    count: int  # N
    columns: int  # D
    means: Any  # [N * 3]
    quats: Any | None  # [N * 4], with scales; None with covars
    scales: Any | None  # [N * 3]
    covars: Any | None  # [N * 9]
    opacities: Any  # [N]
    colors: Any  # [N * D]
    view: Any  # [16]
    intrinsics: Any  # [9]


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


def read_camera(be: Backend, arrays: Arrays, settings: Settings) -> Camera:
    """Registers of one camera."""
    J = be.plain

    def value(source: Any, i: int) -> Any:
        return dr.gather(J.Float, source, J.UInt32(i))

    s = settings
    limits = (s.width, s.height, s.near, s.far_plane, s.eps2d, s.radius_clip)
    opaque = [dr.opaque(J.Float, float(limit)) for limit in limits]
    intrinsics = [value(arrays.intrinsics, i) for i in (0, 4, 2, 5)]
    return Camera([value(arrays.view, i) for i in range(12)], intrinsics, *opaque)


def read_splats(be: Backend, arrays: Arrays, i: Any) -> tuple[list[Any], Shape, Any]:
    """Mean, shape and opacity of splats `i`."""
    J = be.plain

    def row(source: Any, size: int) -> list[Any]:
        return [] if source is None else [dr.gather(J.Float, source, size * i + k) for k in range(size)]

    quat = [] if arrays.quats is None else packet(be, arrays.quats, i, 4)
    return row(arrays.means, 3), Shape(quat, row(arrays.scales, 3), row(arrays.covars, 9)), row(arrays.opacities, 1)[0]


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


@dataclass(frozen=True)
class Projected:
    """Results of the projection kernel for N splats."""

    records: Any  # [N * RECORD]
    footprints: Any  # [N * 8]
    bounds: Any | None  # [N * 2] first and last tile column, where the rules clip footprints to a square
    depths: Any  # [N] camera z
    opacities: Any  # [N] after the antialiasing factor
    compensation: Any | None  # [N] that factor
    counts: Any  # [N] tiles
    visible: Any  # [N] Bool
    radii: Any  # [N * 2] Int32
    pairs: int
    box_pairs: int  # pairs of the bounding boxes, where they are counted
    culled: dict[str, int]
    nonfinite: bool


def _finite(be: Backend, values: list[Any]) -> Any:
    """Whether every value is finite, by its bits: fast-math comparisons may assume that NaNs do not occur."""
    exponent = 0x7F800000
    finite = be.plain.Bool(True)
    for value in values:
        finite &= (bits_of(be, value) & exponent) != exponent
    return finite


def run(be: Backend, arrays: Arrays, features: int, first_features: int, cam: Camera, settings: Settings) -> Projected:
    """Project N >= 1 splats.

    The record takes the first `first_features` features; when depth is one of them it is the last of all.
    """
    J = be.plain
    n, columns, options = arrays.count, arrays.columns, settings.options
    i = dr.arange(J.UInt32, n)
    mean, shape, opacity = read_splats(be, arrays, i)
    colors = [dr.gather(J.Float, arrays.colors, columns * i + j) for j in range(columns)]
    finite = _finite(be, [*mean, *shape.quat, *shape.scale, *shape.covariance, opacity, *colors])

    e = project(mean, shape, opacity, cam, settings)
    geometry = e.geometry()
    log_reach = geometry[5] if options.opacity_extent else larger(geometry[5], 0.0)
    foot = footprint(e, log_reach, cam, settings)
    bright = (e.opacity >= options.alpha_min) if options.opacity_extent else J.Bool(True)
    exact = (2 / LOG2E) * larger(log_reach - math.log2(options.alpha_min), 0.0)
    extent_x, extent_y = dr.sqrt(exact * e.xx), dr.sqrt(exact * e.yy)
    on_screen = (e.x + extent_x > 0.5) & (e.x - extent_x < cam.width - 0.5)
    on_screen &= (e.y + extent_y > 0.5) & (e.y - extent_y < cam.height - 0.5)
    radius_x, radius_y = dr.ceil(extent_x), dr.ceil(extent_y)
    limits = None
    if settings.inria:
        radius_x = radius_y = square_radius(e)
        rows, limits = square_limits(e.x, e.y, radius_x, cam)
        foot = foot.clipped(rows, limits)
        on_screen &= (rows[0] <= rows[1]) & (limits[0] <= limits[1])
    large = (radius_x > cam.radius_clip) | (radius_y > cam.radius_clip)
    if not options.cull_offscreen:
        on_screen = J.Bool(True)
    reason = J.UInt32(0)
    for code, kept in ((5, large), (4, on_screen), (3, bright), (2, e.invertible), (1, e.in_range)):
        reason = dr.select(kept, reason, J.UInt32(code))
    visible = finite & (reason == 0)
    counts = count_tiles(be, foot, cam.width, visible)

    records, footprints = dr.empty(J.Float, n * RECORD), dr.empty(J.Float, n * 8)
    values = [*colors, e.z][:first_features] if features > columns else colors[:first_features]
    values += [J.Float(0)] * (power_of_two(first_features) - first_features)
    bends = [dr.exp2(-2.0 * geometry[2]), dr.exp2(-2.0 * geometry[2] * geometry[3])]
    write_packet(be, records, [*geometry, *bends], 2 * i)
    ratio = RECORD // len(values)
    write_packet(be, records, values, ratio * i + ratio // 2)
    write_packet(be, footprints, foot.stored(), i)
    radii = dr.empty(J.Int32, 2 * n)
    write(radii, dr.select(visible, J.Int32(radius_x), 0), 2 * i)
    write(radii, dr.select(visible, J.Int32(radius_y), 0), 2 * i + 1)
    bounds = None
    if limits is not None:
        bounds = dr.empty(J.Float, n * 2)
        write_packet(be, bounds, list(limits), i)
    tally = dr.zeros(J.UInt64, PAIRS + 1)
    dr.scatter_add(tally, J.UInt64(counts), J.UInt32(PAIRS), mode=be.scatter_mode)
    dr.scatter_add(tally, J.UInt64(1), dr.select(finite, reason, NONFINITE), mode=be.scatter_mode)
    if options.count_skips:
        box = J.UInt64(dr.select(visible, foot.box_tiles(extent_x, cam.width), 0.0))
        dr.scatter_add(tally, box, J.UInt32(BOX_PAIRS), mode=be.scatter_mode)
    opacities = e.opacity if settings.antialiased else arrays.opacities
    dr.eval(records, footprints, bounds, e.z, counts, visible, radii, tally, opacities, e.factor)
    totals = [int(total) for total in tally.numpy()]
    culled = {name: totals[code] for code, name in enumerate(CULLED) if code}
    return Projected(
        records,
        footprints,
        bounds,
        e.z,
        opacities,
        e.factor,
        counts,
        visible,
        radii,
        totals[PAIRS],
        totals[BOX_PAIRS],
        culled,
        totals[NONFINITE] > 0,
    )
