"""Which tiles a projected splat can reach: the arithmetic that counting and emitting share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import TILE, Backend, larger, smaller
from ._ewa import Ellipse
from ._lens import Camera
from ._settings import Settings


@dataclass(frozen=True)
class Footprint:
    """Pixels a splat can reach (alpha >= ALPHA_MIN), as an ellipse sliced by rows of tiles."""

    x: Any
    y: Any
    slope: Any  # dx / dy of the slice centres
    reach: Any  # half height
    stretch: Any  # squared ratio of the half width of the slice through the centre to the half height
    turn: Any  # dy of the rightmost point
    first: Any  # first and last tile row, as floats; first > last when there is none
    last: Any
    box: bool = False  # whether every row spans the whole bounding box
    limits: Sequence[Any] | None = None  # first and last tile column that the rules allow
    tile_width: int = TILE  # pixels

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
        scale = 1.0 / self.tile_width
        first, last = dr.select(missed, 1.0, dr.floor(first * scale)), dr.select(missed, 0.0, dr.floor(last * scale))
        if self.limits is None:
            return first, last
        return larger(first, self.limits[0]), smaller(last, self.limits[1])

    def _edge(self, dy: Any, side: float) -> Any:
        if self.box:
            return side * self.reach * dr.sqrt(self.stretch)
        half = dr.sqrt(larger(self.stretch * (self.reach - dy) * (self.reach + dy), 0.0))
        return dr.fma(self.slope, dy, side * half)

    def clipped(self, rows: Sequence[Any], columns: Sequence[Any]) -> Footprint:
        """This footprint within some rows and columns of tiles."""
        return replace(self, first=larger(self.first, rows[0]), last=smaller(self.last, rows[1]), limits=columns)

    def stored(self) -> list[Any]:
        """The eight numbers that `columns` needs besides the limits."""
        return [self.x, self.y, self.slope, self.reach, self.stretch, self.turn, self.first, self.last]

    def box_tiles(self, extent_x: Any, image_width: Any) -> Any:
        """Number of tiles of the bounding box, half as wide as `extent_x`."""
        first = larger(dr.floor((self.x - extent_x) / self.tile_width), 0.0)
        last = smaller(dr.floor((self.x + extent_x) / self.tile_width), dr.ceil(image_width / self.tile_width) - 1.0)
        return larger(last - first + 1.0, 0.0) * larger(self.last - self.first + 1.0, 0.0)


def footprint(ellipse: Ellipse, log_opacity: Any, cam: Camera, settings: Settings) -> Footprint:
    """Footprint of a projected splat of an opacity 2**`log_opacity` above the threshold."""
    e = ellipse
    threshold = (2 / c.LOG2E) * larger(log_opacity + (c.CUT_SLACK - math.log2(settings.options.alpha_min)), 0.0)
    reach = dr.sqrt(threshold * e.yy)
    first = larger(dr.ceil(e.y - reach - 0.5), 0.0)
    last = smaller(dr.floor(e.y + reach - 0.5), cam.height - 1.0)
    missed = first > last
    scale = 1.0 / TILE
    exact = settings.options.exact_tiles
    return Footprint(
        e.x,
        e.y,
        e.xy / e.yy,
        reach,
        e.determinant / e.yy / e.yy if exact else e.xx / e.yy,
        e.xy * dr.sqrt(threshold / e.xx),
        dr.select(missed, 1.0, dr.floor(first * scale)),
        dr.select(missed, 0.0, dr.floor(last * scale)),
        box=not exact,
        tile_width=TILE * settings.options.list_width,
    )


def square_radius(ellipse: Ellipse) -> Any:
    """Radius (pixels) of three standard deviations along the longer axis, by the original rasterizer's formula."""
    mean = 0.5 * (ellipse.xx + ellipse.yy)
    half = dr.sqrt(larger(mean * mean - ellipse.determinant, c.EIGENVALUE_FLOOR_INRIA))
    return dr.ceil(3.0 * dr.sqrt(mean + half))


def square_limits(x: Any, y: Any, radius: Any, cam: Camera, tile_width: int) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """First and last row and column of our tiles in the original's tiles that a square of `radius` touches."""

    def span(centre: Any, size: Any, ratio: int) -> tuple[Any, Any]:
        most = dr.ceil(size / c.TILE_INRIA)
        first = larger(dr.floor((centre - 0.5 - radius) / c.TILE_INRIA), 0.0)
        end = smaller(dr.floor((centre - 0.5 + radius + (c.TILE_INRIA - 1.0)) / c.TILE_INRIA), most)
        return first * ratio, end * ratio - 1.0

    return span(y, cam.height, c.TILE_INRIA // TILE), span(x, cam.width, c.TILE_INRIA // tile_width)


def count_tiles(be: Backend, foot: Footprint, image_width: Any, active: Any) -> Any:
    """Number of tiles of each lane's footprint."""
    J = be.plain

    def body(row: Any, count: Any) -> tuple[Any, Any]:
        first, last = foot.columns(row, image_width)
        return row + 1.0, count + J.UInt32(larger(last - first + 1.0, 0.0))

    start = dr.select(active, foot.first, foot.last + 1.0)
    _, count = dr.while_loop((start, J.UInt32(0)), lambda row, count: row <= foot.last, body, mode="symbolic")
    return count
