"""Depth order and per-tile lists of splats."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import TILE, Backend, bits_of, packet, power_of_two, smaller, write
from ._footprint import Footprint
from ._project import Projected
from ._settings import Options, Settings
from .profiling import stage

DIGIT_BITS = 12  # widest digit whose bucket counts stay in the first-level cache during a counting pass
BYTES_PER_PAIR = 24
REGION = 16  # tiles along each side of a region: its splats fit the second-level cache
LENGTH_BUCKETS = 1024  # longer lists count as equally long when lanes are matched
EMIT_BLOCK = 4096  # splats among which lanes are matched; what they emit fits the second-level cache


@dataclass(frozen=True)
class TileLists:
    """For each tile the splats that can touch it, near to far: `ids[start[l]:start[l + 1]]` of its list `l`."""

    ids: Any  # [pairs] splat of each entry
    start: Any  # [lists + 2], the last for the unused tile
    order: Any  # [lanes] the tile that each lane renders, `tiles` in idle lanes
    columns: int  # of tiles
    rows: int
    width: int  # tiles, side by side, that share a list

    @property
    def tiles(self) -> int:
        """Number of tiles of the image."""
        return self.columns * self.rows

    def span(self, be: Backend, tile: Any) -> tuple[Any, Any]:
        """Range of the list of each `tile`; empty for the unused one."""
        J = be.plain
        across = -(-self.columns // self.width)
        if self.width > 1:
            columns = dr.opaque(J.UInt32, self.columns)
            row = tile // columns
            tile = row * dr.opaque(J.UInt32, across) + (tile - row * columns) // self.width
        return dr.gather(J.UInt32, self.start, tile), dr.gather(J.UInt32, self.start, tile + 1)

    def lengths(self, be: Backend, end: Any | None = None) -> Any:
        """Entries of each tile's list, up to `end` [tiles] when it is given."""
        first, last = self.span(be, dr.arange(be.plain.UInt32, self.tiles))
        lengths = (last if end is None else end) - first
        dr.eval(lengths)
        return lengths


def _sorted_by(be: Backend, keys: Any, bits: int) -> Any:
    """Stable ascending order of unsigned `keys` below 2**bits, least significant digit first."""
    J = be.plain
    n = dr.width(keys)
    passes = max(1, -(-bits // DIGIT_BITS))
    digit_bits = -(-bits // passes) if bits else 1
    order = None
    for i in range(passes):
        shift = dr.opaque(J.UInt32, i * digit_bits)
        moved = keys if order is None else dr.gather(J.UInt32, keys, order)
        digit = (moved >> shift) & dr.opaque(J.UInt32, (1 << digit_bits) - 1)
        dr.eval(digit)
        step = dr.detail.block_mkperm(digit, n, 1 << digit_bits)
        order = step if order is None else dr.gather(J.UInt32, order, step)
    return order


def depth_order(be: Backend, projected: Projected) -> Any:
    """Splat ids by increasing depth, ties by id, culled splats last; exact for every range of depths."""
    J = be.plain
    # Positive floats order like their bits, so subtracting the smallest keeps the order and shortens the key.
    bits = bits_of(be, projected.depths)
    low: Any = dr.min(dr.select(projected.visible, bits, J.UInt32(0xFFFFFFFF)))
    high: Any = dr.max(dr.select(projected.visible, bits, J.UInt32(0)))
    dr.eval(low, high)
    keys = dr.select(projected.visible, bits, high) - low
    return _sorted_by(be, keys, (int(high[0]) - int(low[0])).bit_length())


def available_memory() -> int | None:
    """Bytes that could be had, counting what the system keeps of files, which it gives back; None if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        lines = []
    found = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    if found:
        return 1024 * found[0]
    if "SC_AVPHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def check_pairs(pairs: int, be: Backend) -> None:
    """Raise MemoryError when the lists of `pairs` (tile, splat) pairs could not be indexed or stored."""
    available = available_memory() if be.is_cpu else None
    needed = pairs * BYTES_PER_PAIR
    if pairs > c.MAX_PAIRS or (available is not None and needed > available):
        raise MemoryError(
            f"the splats cover {pairs} (tile, splat) pairs, which need {needed / 2**30:.1f} GiB; "
            "use smaller scales, fewer splats or a smaller image"
        )


def _emit(
    be: Backend, projected: Projected, order: Any, columns: Any, image_width: Any, outside: Any, options: Options
) -> tuple[Any, Any]:
    """Tile and splat of every pair, splats in depth order."""
    J = be.plain
    counts = dr.gather(J.UInt32, projected.counts, order)
    clipped = smaller(counts, J.UInt32(LENGTH_BUCKETS - 1))
    dr.eval(counts, clipped)
    begin = dr.prefix_sum(counts)
    # The places are known, so lanes may take the splats in any order: those of a packet get equally large ones.
    lane = dr.detail.block_mkperm(clipped, EMIT_BLOCK, LENGTH_BUCKETS)
    order, begin, counts = (dr.gather(J.UInt32, values, lane) for values in (order, begin, counts))
    tile, splat = dr.empty(J.UInt32, projected.pairs), dr.empty(J.UInt32, projected.pairs)
    foot = Footprint(*packet(be, projected.footprints, order, 8))
    limits = None if projected.bounds is None else packet(be, projected.bounds, order, 2)
    foot = replace(foot, box=not options.exact_tiles, limits=limits, tile_width=TILE * options.list_width)

    def body(k: Any, row: Any, column: Any, last: Any) -> tuple[Any, ...]:
        # A count that disagreed with the spans could only send entries to the unused tile, never out of bounds.
        emits = (column <= last) | (row > foot.last)
        write(tile, dr.select(row <= foot.last, J.UInt32(row) * columns + J.UInt32(column), outside), k, emits)
        write(splat, order, k, emits)
        k = dr.select(emits, k + 1, k)
        next_row = column >= last
        row = dr.select(next_row, row + 1.0, row)
        first_column, last_column = foot.columns(row, image_width)
        return k, row, dr.select(next_row, first_column, column + 1.0), dr.select(next_row, last_column, last)

    end = begin + counts
    column, last = foot.columns(foot.first, image_width)
    dr.while_loop((begin, foot.first, column, last), lambda k, row, column, last: k < end, body, mode="symbolic")
    dr.eval(tile, splat)
    return tile, splat


def _starts(be: Backend, tile: Any, order: Any, tiles: int, pairs: int) -> Any:
    """For each tile, the unused one and one past it, the first position in `tile[order]` that is not below it."""
    J = be.plain
    wanted = dr.arange(J.UInt32, tiles + 2)

    def body(low: Any, high: Any) -> tuple[Any, Any]:
        middle = (low + high) >> 1
        below = dr.gather(J.UInt32, tile, dr.gather(J.UInt32, order, middle)) < wanted
        return dr.select(below, middle + 1, low), dr.select(below, high, middle)

    low, _ = dr.while_loop(
        (J.UInt32(0), dr.opaque(J.UInt32, pairs)), lambda low, high: low < high, body, mode="symbolic"
    )
    return low


def lane_order(be: Backend, lengths: Any, columns: int, rows: int) -> Any:
    """The tile that each lane takes: region by region, and by decreasing work inside a region.

    Neighbouring tiles share splats, so a region's records and gradients stay in a core's cache; the lanes of one packet
    get lists of similar length. Lanes of a region that hang over the image take the tile number `columns * rows`.
    """
    J = be.plain
    across, down = -(-columns // REGION), -(-rows // REGION)
    area = REGION * REGION
    lane = dr.arange(J.UInt32, across * down * area)
    opaque_across = dr.opaque(J.UInt32, across)
    region, local = lane // area, lane % area
    region_row = region // opaque_across
    x = (region - region_row * opaque_across) * REGION + local % REGION
    y = region_row * REGION + local // REGION
    inside = (x < dr.opaque(J.UInt32, columns)) & (y < dr.opaque(J.UInt32, rows))
    tile = dr.select(inside, y * dr.opaque(J.UInt32, columns) + x, dr.opaque(J.UInt32, columns * rows))
    top = LENGTH_BUCKETS - 1
    keys = J.UInt32(top) - smaller(dr.gather(J.UInt32, lengths, tile, inside), J.UInt32(top))
    dr.eval(keys, tile)
    return dr.gather(J.UInt32, tile, dr.detail.block_mkperm(keys, area, LENGTH_BUCKETS))


def empty(be: Backend, settings: Settings) -> TileLists:
    """Lists of tiles that no splat touches."""
    J = be.plain
    columns, rows, across = _grid(settings)
    ids, start = dr.zeros(J.UInt32, 1), dr.zeros(J.UInt32, across * rows + 2)
    dr.make_opaque(ids, start)
    return _ordered(be, TileLists(ids, start, None, columns, rows, settings.options.list_width))


def _grid(settings: Settings) -> tuple[int, int, int]:
    """Columns and rows of tiles, and lists in a row."""
    columns = -(-settings.width // TILE)
    return columns, -(-settings.height // TILE), -(-columns // settings.options.list_width)


def _ordered(be: Backend, lists: TileLists, work: Any | None = None) -> TileLists:
    work = lists.lengths(be) if work is None else work
    return replace(lists, order=lane_order(be, work, lists.columns, lists.rows))


def build(be: Backend, projected: Projected, settings: Settings, work: Any | None = None) -> TileLists:
    """Lists for a projection with at least one pair; lanes are matched by the `work` [tiles] expected of each tile, or
    by the lengths of the lists.
    """
    J = be.plain
    check_pairs(projected.pairs, be)
    columns, rows, across = _grid(settings)
    count = across * rows
    with stage("sort"):
        order = depth_order(be, projected)
    with stage("emit"):
        tile, splat = _emit(
            be,
            projected,
            order,
            dr.opaque(J.UInt32, across),
            dr.opaque(J.Float, float(settings.width)),
            dr.opaque(J.UInt32, count),
            settings.options,
        )
    with stage("bin"):
        by_tile = _by_tile(be, tile, count, projected.pairs)
    with stage("lists"):
        start = _starts(be, tile, by_tile, count, projected.pairs)
        ids = dr.gather(J.UInt32, splat, by_tile)
        dr.eval(start, ids)
        return _ordered(be, TileLists(ids, start, None, columns, rows, settings.options.list_width), work)


def _by_tile(be: Backend, tile: Any, tiles: int, pairs: int) -> Any:
    """Stable order of the pairs by tile; one counting pass unless its buckets would outgrow the cache."""
    buckets = power_of_two(tiles + 1)
    if buckets <= 1 << 17:
        return dr.detail.block_mkperm(tile, pairs, buckets)
    return _sorted_by(be, tile, buckets.bit_length() - 1)
