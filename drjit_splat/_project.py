"""The kernel that projects splats and writes their records."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import Backend, bits_of, larger, packet, power_of_two, write, write_packet
from ._ewa import Shape, project
from ._footprint import count_tiles, footprint, square_limits, square_radius
from ._lens import Camera, exact_centre
from ._settings import Settings

RECORD = 16  # floats a splat: 8 of geometry (see Ellipse.geometry, with x and y relative to the middle of the image;
# 2^-2a, 2^-2ah), then up to 8 features
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
    radial: Any | None = None  # [4] of a distorted lens


def read_camera(be: Backend, arrays: Arrays, settings: Settings) -> Camera:
    """Registers of one camera."""
    J = be.plain

    def value(source: Any, i: int) -> Any:
        return dr.gather(J.Float, source, J.UInt32(i))

    s = settings
    limits = (s.width, s.height, s.near, s.far_plane, s.eps2d, s.radius_clip)
    opaque = [dr.opaque(J.Float, float(limit)) for limit in limits]
    intrinsics = [value(arrays.intrinsics, i) for i in (0, 4, 2, 5)]
    radial = [] if arrays.radial is None else [value(arrays.radial, i) for i in range(4)]
    return Camera([value(arrays.view, i) for i in range(12)], intrinsics, radial, *opaque)


def read_splats(be: Backend, arrays: Arrays, i: Any) -> tuple[list[Any], Shape, Any]:
    """Mean, shape and opacity of splats `i`."""
    J = be.plain

    def row(source: Any, size: int) -> list[Any]:
        return [] if source is None else [dr.gather(J.Float, source, size * i + k) for k in range(size)]

    quat = [] if arrays.quats is None else packet(be, arrays.quats, i, 4)
    return row(arrays.means, 3), Shape(quat, row(arrays.scales, 3), row(arrays.covars, 9)), row(arrays.opacities, 1)[0]


@dataclass(frozen=True)
class Queued:
    """Results of a projection kernel that may still run; see `Projected`."""

    records: Any  # [N * RECORD]
    footprints: Any  # [N * 8]
    bounds: Any | None  # [N * 2] first and last tile column, where the rules clip footprints to a square
    depths: Any  # [N] camera z
    opacities: Any  # [N] after the antialiasing factor
    compensation: Any | None  # [N] that factor
    counts: Any  # [N] tiles
    visible: Any  # [N] Bool
    radii: Any  # [N * 2] Int32
    tally: Any  # [PAIRS + 1] splats by reason of culling, then what the names of its places say

    def result(self) -> Projected:
        """The same once the kernel has ended; waits for it."""
        totals = [int(total) for total in self.tally.numpy()]
        culled = {name: totals[code] for code, name in enumerate(CULLED) if code}
        return Projected(
            **vars(self),
            pairs=totals[PAIRS],
            box_pairs=totals[BOX_PAIRS],
            culled=culled,
            nonfinite=totals[NONFINITE] > 0,
        )


@dataclass(frozen=True)
class Projected(Queued):
    """Results of the projection kernel for N splats."""

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


def run(be: Backend, arrays: Arrays, features: int, first_features: int, cam: Camera, settings: Settings) -> Queued:
    """Project N >= 1 splats.

    The record takes the first `first_features` features; when depth is one of them it is the last of all.
    """
    J = be.plain
    n, columns, options = arrays.count, arrays.columns, settings.options
    i = dr.arange(J.UInt32, n)
    mean, shape, opacity = read_splats(be, arrays, i)
    # Of more channels the caller has checked that they are finite, and later chunks read their own.
    read = columns if columns <= c.MAX_CHECKED else min(columns, first_features)
    colors = [dr.gather(J.Float, arrays.colors, columns * i + j) for j in range(read)]
    finite = _finite(be, [*mean, *shape.quat, *shape.scale, *shape.covariance, opacity, *colors])

    e = project(mean, shape, opacity, cam, settings)
    centre = exact_centre(be, mean, cam, settings)
    e = replace(e, x=centre[0] + 0.5 * cam.width, y=centre[1] + 0.5 * cam.height)
    geometry = [*centre, *e.geometry()[2:]]
    log_reach = geometry[5] if options.opacity_extent else larger(geometry[5], 0.0)
    foot = footprint(e, log_reach, cam, settings)
    bright = (e.opacity >= options.alpha_min) if options.opacity_extent else J.Bool(True)
    exact = (2 / c.LOG2E) * larger(log_reach - math.log2(options.alpha_min), 0.0)
    extent_x, extent_y = dr.sqrt(exact * e.xx), dr.sqrt(exact * e.yy)
    on_screen = (e.x + extent_x > 0.5) & (e.x - extent_x < cam.width - 0.5)
    on_screen &= (e.y + extent_y > 0.5) & (e.y - extent_y < cam.height - 0.5)
    radius_x, radius_y = dr.ceil(extent_x), dr.ceil(extent_y)
    limits = None
    if settings.inria:
        radius_x = radius_y = square_radius(e)
        rows, limits = square_limits(e.x, e.y, radius_x, cam, foot.tile_width)
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
    values = ([*colors, e.z] if features > columns and read == columns else colors)[:first_features]
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
    return Queued(records, footprints, bounds, e.z, opacities, e.factor, counts, visible, radii, tally)
