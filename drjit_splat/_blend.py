"""Front-to-back blending: one SIMD lane renders one 4x4 tile."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr

from ._backend import (
    PIXELS,
    RECORDINGS,
    TILE,
    Backend,
    bits_of,
    exp2,
    larger,
    packet,
    power_of_two,
    recorded,
    smaller,
    write,
)
from ._binning import TileLists
from ._project import RECORD
from ._settings import Settings

UNDERFLOW = 126 * math.log(2.0)  # nats

UNROLL = 3
"""List entries a turn of the loop. Every turn saves and selects all sums, and waits for its gathers, once."""

SIGN = 0x80000000


def uses_recurrence(settings: Settings) -> bool:
    """Whether a tile's corner, from which the recurrence starts, cannot underflow where another pixel counts.

    The exponent there is at most (sqrt(2 ln 1/alpha_min) + 3 sqrt(2 / eps2d))^2 / 2 nats.
    """
    if settings.eps2d == 0:
        return False
    reach = math.sqrt(-2 * math.log(settings.options.alpha_min)) + 3 * math.sqrt(2 / settings.eps2d)
    return reach * reach / 2 <= UNDERFLOW


@dataclass(frozen=True)
class Tile:
    """Position of each lane's tile."""

    index: Any
    x: Any  # pixel column and row of its first pixel
    y: Any
    first: Any  # range of its list
    last: Any
    width: Any
    height: Any
    used: Any  # whether the lane has a tile of the image

    def pixels(self) -> list[tuple[Any, Any]]:
        """Flat index of each of the 16 pixels and whether it lies in the image, row by row."""
        found = []
        for k in range(PIXELS):
            x, y = self.x + k % TILE, self.y + k // TILE
            found.append((y * self.width + x, (x < self.width) & (y < self.height)))
        return found


def tile_of(be: Backend, index: Any, lists: TileLists, settings: Settings) -> Tile:
    """Tile `index` of each lane."""
    J = be.plain
    columns = dr.opaque(J.UInt32, lists.columns)
    row = index // columns
    return Tile(
        index,
        (index - row * columns) * TILE,
        row * TILE,
        *lists.span(be, index),
        dr.opaque(J.UInt32, settings.width),
        dr.opaque(J.UInt32, settings.height),
        index < dr.opaque(J.UInt32, lists.tiles),
    )


def offsets(be: Backend, tile: Tile, geometry: list[Any]) -> tuple[Any, Any]:
    """dx + h dy and dy from the splat's mean to the centre of the tile's first pixel."""
    J = be.plain
    dx = dr.fma(-0.5, J.Float(tile.width), J.Float(tile.x) + 0.5) - geometry[0]
    dy = dr.fma(-0.5, J.Float(tile.height), J.Float(tile.y) + 0.5) - geometry[1]
    return dr.fma(geometry[3], dy, dx), dy


def raw_alphas(be: Backend, geometry: list[Any], s: Any, t: Any, settings: Settings, active: Any) -> Iterator[Any]:
    """opacity * exp(-sigma) at the tile's 16 pixels, row by row; next to nothing in lanes that are not active
    (their geometry must be zero, or the ratios could make something of it).

    Along a row and down the first column the Gaussian's ratio of neighbours is itself geometric, so two
    multiplications a pixel replace an exponential. `s`, `t` are as `offsets` gives them.
    """
    _, _, a, h, d, log_opacity, bend_x, twist = geometry
    log_opacity = dr.select(active, log_opacity, -125.0)
    degree = settings.options.exp_degree
    if not uses_recurrence(settings):
        for k in range(PIXELS):
            row = float(k // TILE)
            x, y = dr.fma(h, row, s + float(k % TILE)), t + row
            yield exp2(be, log_opacity - dr.fma(a * x, x, d * y * y), degree)
        return
    ah = a * h
    exponent = log_opacity - dr.fma(a * s, s, d * t * t)
    corner = exp2(be, exponent, degree)
    right = exp2(be, -a * dr.fma(2.0, s, 1.0), degree)
    down = exp2(be, -dr.fma(ah, dr.fma(2.0, s, h), d * dr.fma(2.0, t, 1.0)), degree)
    bend_y = exp2(be, -2.0 * dr.fma(ah, h, d), degree)
    if not settings.options.exact_tiles or settings.options.list_width > 1:
        # The list's tile may lie so far from the ellipse that its corner underflows: nothing is seen there.
        seen = exponent > -124.0
        corner, right, down = (dr.select(seen, value, 0.0) for value in (corner, right, down))
    for row in range(TILE):
        value, ratio = corner, right
        for column in range(TILE):
            yield value
            if column < TILE - 1:
                value = value * ratio
            if column < TILE - 2:
                ratio = ratio * bend_x
        if row < TILE - 1:
            corner, right = corner * down, right * twist
        if row < TILE - 2:
            down = down * bend_y


def clamped_alpha(raw: Any, settings: Settings) -> Any:
    """Opacity of a pair: held at the largest, nothing below the smallest that counts."""
    return dr.select(raw < settings.options.alpha_min, 0.0, smaller(raw, settings.alpha_max))


def step(be: Backend, alpha: Any, transmittance: Any, settings: Settings) -> tuple[Any, Any, Any]:
    """Whether the pair is blended, its weight, and the transmittance behind it (negated once the pixel has stopped)."""
    after = dr.fma(-alpha, transmittance, transmittance)
    alive = after > settings.options.transmittance_min
    if settings.closing:
        # A pixel that stops here has a positive transmittance left; one that has stopped before has the negative zero.
        rest = larger(transmittance, 0.0)
        return alive, dr.select(alive, alpha * transmittance, rest), dr.select(alive, after, -0.0)
    stopped = dr.reinterpret_array(be.plain.Float, bits_of(be, transmittance) | SIGN)
    return alive, dr.select(alive, alpha * transmittance, 0.0), dr.select(alive, after, stopped)


def entries(be: Backend, lists: TileLists, k: Any, stop: Any, count: int) -> list[Any]:
    """The next `count` list entries of each lane, zeros from `stop` on."""
    return [dr.gather(be.plain.UInt32, lists.ids, k + j, k + j < stop) for j in range(count)]


def all_done(be: Backend, transmittances: list[Any]) -> Any:
    """Whether every pixel of the tile has stopped; a stopped pixel carries its transmittance negated."""
    combined = bits_of(be, transmittances[0])
    for transmittance in transmittances[1:]:
        combined &= bits_of(be, transmittance)
    return combined >= SIGN


def read_features(be: Backend, records: Any, splat: Any, count: int, active: Any) -> list[Any]:
    """The first `count` features of a record; zeros where not active."""
    size = power_of_two(count)
    ratio = RECORD // size
    return packet(be, records, ratio * splat + ratio // 2, size, active)[:count]


@dataclass(frozen=True)
class Blended:
    """Image of one chunk of features."""

    features: Any  # [H * W * F]
    transmittance: Any  # [H * W], what is left behind the splats
    coverage: Any | None  # [H * W], the sum of the weights, where a depth is divided by it
    end: Any  # [tiles] one past the last list entry that was looked at


def blend(be: Backend, records: Any, lists: TileLists, features: int, settings: Settings) -> Blended:
    """Blend `features` features of each record, front to back."""
    kernel = _recorded(be, features, lists.columns, lists.rows, settings)
    return Blended(*kernel(records, lists.ids, lists.start, lists.order))


@lru_cache(maxsize=RECORDINGS)
def _recorded(be: Backend, features: int, columns: int, rows: int, settings: Settings) -> Callable[..., Any]:
    """The kernel of one image size and mode, traced at its first call.

    Tracing takes longer than rendering a small image. Repeating a trace is sound here because every size in the kernel
    comes from these arguments; arrays of other lengths are only read.
    """

    def run(records: Any, ids: Any, start: Any, order: Any) -> tuple[Any, Any, Any | None, Any]:
        return _blend(
            be, records, TileLists(ids, start, order, columns, rows, settings.options.list_width), features, settings
        )

    return recorded(run)


def accumulate(
    be: Backend, records: Any, lists: TileLists, features: int, settings: Settings
) -> tuple[Tile, list[list[Any]], Any]:
    """The lanes' tiles; of each of their 16 pixels the transmittance (negated where it has stopped), the sums of the
    features and, where a depth is divided by it, the coverage; and one past the last list entry that was looked at.
    """
    J = be.plain
    # 1 - transmittance has no digits where next to nothing is covered, and an expected depth is divided by it.
    sums = features + int(settings.expected_depth)
    tile = tile_of(be, lists.order, lists, settings)

    # Loop variables, one of each a lane:
    #   k       place in the list of the first of the UNROLL entries of this turn
    #   splats  [UNROLL] those entries: indices of records, read a turn ahead
    #   state   [16][1 + sums] for each pixel its transmittance (negative once it has stopped), the sums of the features
    #           and, where a depth is divided by it, the coverage

    def body(k: Any, splats: list[Any], state: list[list[Any]]) -> tuple[Any, list[Any], list[list[Any]]]:
        state = [list(pixel) for pixel in state]
        ramps, values = [], []
        # -------------------- Entries of the next turn --------------------
        following = entries(be, lists, k + UNROLL, tile.last, UNROLL)
        # -------------------- Records and the start of each recurrence --------------------
        for j, splat in enumerate(splats):
            active = k + j < tile.last
            geometry = packet(be, records, 2 * splat, 8, active)
            values.append(read_features(be, records, splat, features, active))
            ramps.append(raw_alphas(be, geometry, *offsets(be, tile, geometry), settings, active))
        # -------------------- Composite, pixel by pixel, near to far --------------------
        for pixel, raws in zip(state, zip(*ramps, strict=True), strict=True):
            for raw, value in zip(raws, values, strict=True):
                _, weight, pixel[0] = step(be, clamped_alpha(raw, settings), pixel[0], settings)
                for f in range(features):
                    pixel[1 + f] = dr.fma(weight, value[f], pixel[1 + f])
                if settings.expected_depth:
                    pixel[sums] += weight
        return k + UNROLL, following, state

    def go_on(k: Any, splats: list[Any], state: list[list[Any]]) -> Any:
        left = k < tile.last
        return left & ~all_done(be, [pixel[0] for pixel in state]) if settings.options.stop_early else left

    # -------------------- Initial state: pixels outside the image have stopped --------------------
    # A pixel's transmittance and sums stay next to each other: the compiled order follows that of the state.
    start = [
        [dr.select(inside, J.Float(1.0), J.Float(-1.0)), *(J.Float(0) for _ in range(sums))]
        for _, inside in tile.pixels()
    ]
    # -------------------- Loop over the list --------------------
    # The splats of a turn are read a turn ahead: their records are gathers at addresses that wait for them.
    k, _, state = dr.while_loop(
        (tile.first, entries(be, lists, tile.first, tile.last, UNROLL), start),
        go_on,
        body,
        mode="symbolic",
    )
    return tile, state, smaller(k, tile.last)


def _blend(
    be: Backend, records: Any, lists: TileLists, features: int, settings: Settings
) -> tuple[Any, Any, Any | None, Any]:
    """Features [H * W * F], transmittance [H * W], coverage [H * W] or None, and loop ends [tiles]."""
    J = be.plain
    tile, state, last = accumulate(be, records, lists, features, settings)
    size = settings.width * settings.height
    image, left = dr.empty(J.Float, size * features), dr.empty(J.Float, size)
    covered = dr.empty(J.Float, size) if settings.expected_depth else None
    for (index, inside), pixel in zip(tile.pixels(), state, strict=True):
        if covered is not None:
            write(covered, pixel[1 + features], index, inside)
        write(left, dr.abs(pixel[0]), index, inside)
        for f in range(features):
            write(image, pixel[1 + f], index * features + f, inside)
    end = dr.empty(J.UInt32, lists.tiles)
    write(end, last, tile.index, tile.used)
    dr.eval(image, left, covered, end)
    return image, left, covered, end
