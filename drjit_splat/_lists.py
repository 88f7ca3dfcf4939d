"""Depth order and per-tile lists of splats."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import TILE, Backend, bits_of, packet, power_of_two, smaller, write
from ._inputs import Settings
from ._project import Footprint, Projected

DIGIT_BITS = 12  # widest digit whose bucket counts stay in the first-level cache during a counting pass
BYTES_PER_PAIR = 24


@dataclass(frozen=True)
class TileLists:
    """For each tile the splats that can touch it, near to far: `ids[start[t]:start[t + 1]]`."""

    ids: Any  # [pairs] splat of each entry
    start: Any  # [tiles + 1]
    order: Any  # [tiles] the tile that each lane renders
    columns: int
    tiles: int


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


def check_pairs(pairs: int, be: Backend) -> None:
    """Raise MemoryError when the lists of `pairs` (tile, splat) pairs could not be indexed or stored."""
    available = None
    if be.is_cpu and "SC_AVPHYS_PAGES" in getattr(os, "sysconf_names", {}):
        available = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    needed = pairs * BYTES_PER_PAIR
    if pairs > c.MAX_PAIRS or (available is not None and needed > available):
        raise MemoryError(
            f"the splats cover {pairs} ({TILE}x{TILE} tile, splat) pairs, which need {needed / 2**30:.1f} GiB; "
            "use smaller scales, fewer splats or a smaller image"
        )


def _emit(
    be: Backend, projected: Projected, order: Any, columns: Any, image_width: Any, outside: Any
) -> tuple[Any, Any]:
    """Tile and splat of every pair, splats in depth order."""
    J = be.plain
    counts = dr.gather(J.UInt32, projected.counts, order)
    dr.eval(counts)
    begin = dr.prefix_sum(counts)
    tile, splat = dr.empty(J.UInt32, projected.pairs), dr.empty(J.UInt32, projected.pairs)
    foot = Footprint(*packet(be, projected.footprints, order, 8))

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
    """For each tile (and one past the last) the first position in `tile[order]` that is not below it."""
    J = be.plain
    wanted = dr.arange(J.UInt32, tiles + 1)

    def body(low: Any, high: Any) -> tuple[Any, Any]:
        middle = (low + high) >> 1
        below = dr.gather(J.UInt32, tile, dr.gather(J.UInt32, order, middle)) < wanted
        return dr.select(below, middle + 1, low), dr.select(below, high, middle)

    low, _ = dr.while_loop(
        (J.UInt32(0), dr.opaque(J.UInt32, pairs)), lambda low, high: low < high, body, mode="symbolic"
    )
    return low


def lane_order(be: Backend, lengths: Any, tiles: int) -> Any:
    """Tiles by decreasing work, dealt out so that the lanes of a packet and the blocks of a launch are even."""
    J = be.plain
    top = (1 << DIGIT_BITS) - 1
    keys = J.UInt32(top) - smaller(lengths, J.UInt32(top))
    dr.eval(keys)
    by_length = dr.detail.block_mkperm(keys, tiles, top + 1)
    # Sixteen lanes fill the widest packet. Position p takes sorted packet (p mod groups) * share + p // groups' mirror.
    groups = 16
    packets = tiles // 16
    share = packets // groups
    if share == 0:
        return by_length
    i = dr.arange(J.UInt32, tiles)
    group_count, share_count = dr.opaque(J.UInt32, groups), dr.opaque(J.UInt32, share)
    position = i >> 4
    dealt = (position % share_count) * group_count + position // share_count
    source = dr.select(position < group_count * share_count, (dealt << 4) + (i & 15), i)
    return dr.gather(J.UInt32, by_length, source)


def build(be: Backend, projected: Projected, settings: Settings) -> TileLists:
    """Lists for a projection with at least one pair."""
    J = be.plain
    check_pairs(projected.pairs, be)
    columns, rows = -(-settings.width // TILE), -(-settings.height // TILE)
    tiles = columns * rows
    order = depth_order(be, projected)
    tile, splat = _emit(
        be,
        projected,
        order,
        dr.opaque(J.UInt32, columns),
        dr.opaque(J.Float, float(settings.width)),
        dr.opaque(J.UInt32, tiles),
    )
    by_tile = _by_tile(be, tile, tiles, projected.pairs)
    start = _starts(be, tile, by_tile, tiles, projected.pairs)
    ids = dr.gather(J.UInt32, splat, by_tile)
    dr.eval(start, ids)
    i = dr.arange(J.UInt32, tiles)
    lengths = dr.gather(J.UInt32, start, i + 1) - dr.gather(J.UInt32, start, i)
    return TileLists(ids, start, lane_order(be, lengths, tiles), columns, tiles)


def _by_tile(be: Backend, tile: Any, tiles: int, pairs: int) -> Any:
    """Stable order of the pairs by tile; one counting pass unless its buckets would outgrow the cache."""
    buckets = power_of_two(tiles + 1)
    if buckets <= 1 << 17:
        return dr.detail.block_mkperm(tile, pairs, buckets)
    return _sorted_by(be, tile, buckets.bit_length() - 1)
