"""EWA projection of splats: the arithmetic (shared with its adjoint) and the kernel that writes the records."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from . import constants as c
from ._backend import TILE, Backend, bits_of, flat, larger, packet, power_of_two, smaller, write, write_packet
from ._inputs import Settings

LOG2E = math.log2(math.e)
RECORD = 16  # floats a splat: 8 of geometry (see Ellipse.geometry; 2^-2a, 2^-2ah), then up to 8 features
CULLED = ("", "depth", "degenerate", "opacity", "offscreen", "radius_clip")


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
    opacity: Any
    in_range: Any
    invertible: Any

    def geometry(self) -> list[Any]:
        """x, y, a, h, d and log2(opacity) of log2(alpha) = log2(opacity) - (a (dx + h dy)^2 + d dy^2).

        A sum of squares, unlike the expanded quadratic, cannot turn negative by rounding far along a needle.
        """
        bright = self.opacity >= c.ALPHA_MIN
        log_opacity = dr.log2(dr.select(bright, self.opacity, 1.0))
        half = 0.5 * LOG2E
        return [self.x, self.y, half * self.yy / self.determinant, -self.xy / self.yy, half / self.yy, log_opacity]


def read_camera(be: Backend, viewmat: torch.Tensor, K: torch.Tensor, settings: Settings) -> Camera:
    """Registers of one camera; `viewmat` [4, 4] and `K` [3, 3] are float32."""
    J = be.plain
    view, k = flat(J.Float, viewmat), flat(J.Float, K)

    def value(source: Any, i: int) -> Any:
        return dr.gather(J.Float, source, J.UInt32(i))

    limits = (
        settings.width,
        settings.height,
        settings.near_plane,
        settings.far_plane,
        settings.eps2d,
        settings.radius_clip,
    )
    opaque = [dr.opaque(J.Float, float(limit)) for limit in limits]
    return Camera([value(view, i) for i in range(12)], [value(k, i) for i in (0, 4, 2, 5)], *opaque)


def project(
    mean: list[Any], quat: list[Any], scale: list[Any], opacity: Any, cam: Camera, antialiased: bool
) -> Ellipse:
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
        margin = 0.5 * c.FRUSTUM_MARGIN * size / focal
        return smaller(larger(slope, -centre / focal - margin), (size - centre) / focal + margin)

    cu, cw = clamped(u, fx, cx, cam.width), clamped(w, fy, cy, cam.height)
    top = [fx * inv_z * (v[k] - cu * v[8 + k]) for k in range(3)]
    low = [fy * inv_z * (v[4 + k] - cw * v[8 + k]) for k in range(3)]

    squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]
    usable = squared >= c.QUAT_MIN_NORM**2
    inv_norm = 1 / dr.sqrt(dr.select(usable, squared, 1.0))
    qw = dr.select(usable, quat[0] * inv_norm, 1.0)
    qx, qy, qz = (dr.select(usable, q * inv_norm, 0.0) for q in quat[1:])
    columns = (
        (1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy)),
        (2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx)),
        (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy)),
    )
    a = [s * (top[0] * m[0] + top[1] * m[1] + top[2] * m[2]) for s, m in zip(scale, columns, strict=True)]
    b = [s * (low[0] * m[0] + low[1] * m[1] + low[2] * m[2]) for s, m in zip(scale, columns, strict=True)]
    xx = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    xy = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    yy = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    # A sum of squared minors: the difference xx * yy - xy^2 cancels for needles.
    minors = [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    sharp = minors[0] * minors[0] + minors[1] * minors[1] + minors[2] * minors[2]
    determinant = sharp + cam.eps2d * (xx + yy) + cam.eps2d * cam.eps2d
    invertible = (determinant > c.DET_MIN) & (determinant < c.DET_MAX)
    determinant = dr.select(invertible, determinant, 1.0)
    if antialiased:
        opacity = opacity * dr.sqrt(larger(sharp / determinant, c.COMPENSATION_MIN))
    return Ellipse(
        dr.fma(fx, u, cx),
        dr.fma(fy, w, cy),
        pz,
        xx + cam.eps2d,
        xy,
        yy + cam.eps2d,
        determinant,
        opacity,
        in_range,
        invertible,
    )


@dataclass(frozen=True)
class Footprint:
    """Pixels a splat can reach (alpha >= ALPHA_MIN), as an ellipse sliced by rows of tiles."""

    x: Any
    y: Any
    slope: Any  # dx / dy of the slice centres
    reach: Any  # half height
    width2: Any  # squared half width of the slice through the centre
    turn: Any  # dy of the rightmost point
    first: Any  # first and last tile row, as floats; first > last when there is none
    last: Any

    def columns(self, row: Any, image_width: Any) -> tuple[Any, Any]:
        """First and last tile column in tile row `row` (floats); first > last when the row is not touched.

        The counting and the emitting kernel both call this on the same stored numbers.
        """
        base = dr.fma(row, float(TILE), 0.5) - self.y
        low = larger(base, -self.reach)
        high = larger(low, smaller(base + (TILE - 1.0), self.reach))
        right = self._edge(smaller(larger(self.turn, low), high), 1.0)
        left = self._edge(smaller(larger(-self.turn, low), high), -1.0)
        first = larger(dr.ceil(self.x + left - 0.5), 0.0)
        last = smaller(dr.floor(self.x + right - 0.5), image_width - 1.0)
        missed = first > last
        scale = 1.0 / TILE
        return dr.select(missed, 1.0, dr.floor(first * scale)), dr.select(missed, 0.0, dr.floor(last * scale))

    def _edge(self, dy: Any, side: float) -> Any:
        share = dy / self.reach
        half = dr.sqrt(larger(self.width2 * dr.fma(-share, share, 1.0), 0.0))
        return dr.fma(self.slope, dy, side * half)


def footprint(ellipse: Ellipse, log_opacity: Any, cam: Camera) -> Footprint:
    """Footprint of a projected splat whose opacity is at least ALPHA_MIN."""
    e = ellipse
    threshold = (2 / LOG2E) * (log_opacity + (c.CUT_SLACK - math.log2(c.ALPHA_MIN)))
    reach = dr.sqrt(threshold * e.yy)
    first = larger(dr.ceil(e.y - reach - 0.5), 0.0)
    last = smaller(dr.floor(e.y + reach - 0.5), cam.height - 1.0)
    missed = first > last
    scale = 1.0 / TILE
    return Footprint(
        e.x,
        e.y,
        e.xy / e.yy,
        reach,
        threshold * e.determinant / e.yy,
        e.xy * dr.sqrt(threshold / e.xx),
        dr.select(missed, 1.0, dr.floor(first * scale)),
        dr.select(missed, 0.0, dr.floor(last * scale)),
    )


def count_tiles(be: Backend, foot: Footprint, image_width: Any, active: Any) -> Any:
    """Number of tiles of each lane's footprint."""
    J = be.plain

    def body(row: Any, count: Any) -> tuple[Any, Any]:
        first, last = foot.columns(row, image_width)
        return row + 1.0, count + J.UInt32(larger(last - first + 1.0, 0.0))

    start = dr.select(active, foot.first, foot.last + 1.0)
    _, count = dr.while_loop((start, J.UInt32(0)), lambda row, count: row <= foot.last, body, mode="symbolic")
    return count


@dataclass(frozen=True)
class Projected:
    """Results of the projection kernel for N splats."""

    records: Any  # [N * RECORD]
    footprints: Any  # [N * 8]
    depths: Any  # [N] camera z
    counts: Any  # [N] tiles
    visible: Any  # [N] Bool
    radii: Any  # [N * 2] Int32
    pairs: int
    culled: dict[str, int]
    nonfinite: bool


def _finite(be: Backend, values: list[Any]) -> Any:
    """Whether every value is finite, by its bits: fast-math comparisons may assume that NaNs do not occur."""
    exponent = 0x7F800000
    finite = be.plain.Bool(True)
    for value in values:
        finite &= (bits_of(be, value) & exponent) != exponent
    return finite


def run(
    be: Backend, inputs: tuple[torch.Tensor, ...], features: int, first_features: int, cam: Camera, settings: Settings
) -> Projected:
    """Project N >= 1 splats; `inputs` are float32 means, quats, scales, opacities and colours [N, features].

    The record takes the first `first_features` features; when depth is one of them it is the last of all.
    """
    J = be.plain
    n = len(inputs[0])
    sources = [flat(J.Float, t) for t in inputs]
    i = dr.arange(J.UInt32, n)
    mean, scale = ([dr.gather(J.Float, sources[k], 3 * i + j) for j in range(3)] for k in (0, 2))
    quat = packet(be, sources[1], i, 4)
    opacity = dr.gather(J.Float, sources[3], i)
    columns = inputs[4].shape[1]
    colors = [dr.gather(J.Float, sources[4], columns * i + j) for j in range(columns)]
    finite = _finite(be, [*mean, *quat, *scale, opacity, *colors])

    e = project(mean, quat, scale, opacity, cam, settings.antialiased)
    geometry = e.geometry()
    foot = footprint(e, geometry[5], cam)
    bright = e.opacity >= c.ALPHA_MIN
    exact = (2 / LOG2E) * larger(geometry[5] - math.log2(c.ALPHA_MIN), 0.0)
    extent_x, extent_y = dr.sqrt(exact * e.xx), dr.sqrt(exact * e.yy)
    on_screen = (e.x + extent_x > 0.5) & (e.x - extent_x < cam.width - 0.5)
    on_screen &= (e.y + extent_y > 0.5) & (e.y - extent_y < cam.height - 0.5)
    radius_x, radius_y = dr.ceil(extent_x), dr.ceil(extent_y)
    large = (radius_x > cam.radius_clip) | (radius_y > cam.radius_clip)
    reason = J.UInt32(0)
    for code, kept in ((5, large), (4, on_screen), (3, bright), (2, e.invertible), (1, e.in_range)):
        reason = dr.select(kept, reason, J.UInt32(code))
    visible = finite & (reason == 0)
    counts = count_tiles(be, foot, cam.width, visible)

    records, footprints = dr.empty(J.Float, n * RECORD), dr.empty(J.Float, n * 8)
    zero = J.Float(0)
    values = [*colors, e.z][:first_features] if features > columns else colors[:first_features]
    values += [zero] * (power_of_two(first_features) - first_features)
    bends = [dr.exp2(-2.0 * geometry[2]), dr.exp2(-2.0 * geometry[2] * geometry[3])]
    write_packet(be, records, [*geometry, *bends], 2 * i)
    ratio = RECORD // len(values)
    write_packet(be, records, values, ratio * i + ratio // 2)
    write_packet(
        be, footprints, [foot.x, foot.y, foot.slope, foot.reach, foot.width2, foot.turn, foot.first, foot.last], i
    )
    radii = dr.empty(J.Int32, 2 * n)
    write(radii, dr.select(visible, J.Int32(radius_x), 0), 2 * i)
    write(radii, dr.select(visible, J.Int32(radius_y), 0), 2 * i + 1)
    tally = dr.zeros(J.UInt64, 8)
    dr.scatter_add(tally, J.UInt64(counts), J.UInt32(7), mode=be.scatter_mode)
    dr.scatter_add(tally, J.UInt64(1), dr.select(finite, reason, 6), mode=be.scatter_mode)
    dr.eval(records, footprints, e.z, counts, visible, radii, tally)
    totals = [int(total) for total in tally.numpy()]
    culled = {name: totals[code] for code, name in enumerate(CULLED) if code}
    return Projected(records, footprints, e.z, counts, visible, radii, totals[7], culled, totals[6] > 0)
