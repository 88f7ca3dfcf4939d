"""Front-to-back blending: one SIMD lane renders one 4x4 tile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import PIXELS, TILE, Backend, bits_of, packet, power_of_two, write
from ._inputs import Settings
from ._lists import TileLists, lane_order
from ._project import RECORD

RECURRENCE_EPS2D = 0.25
"""Least low-pass (pixels^2) for which a tile's corner, from which the recurrence starts, cannot underflow: the
exponent there is at most (sqrt(2 ln 255) + 3 sqrt(2 / eps2d))^2 / 2 nats."""


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
        dr.gather(J.UInt32, lists.start, index),
        dr.gather(J.UInt32, lists.start, index + 1),
        dr.opaque(J.UInt32, settings.width),
        dr.opaque(J.UInt32, settings.height),
    )


def offsets(be: Backend, tile: Tile, geometry: list[Any]) -> tuple[Any, Any]:
    """dx + h dy and dy from the splat's mean to the centre of the tile's first pixel."""
    dx, dy = be.plain.Float(tile.x) + 0.5 - geometry[0], be.plain.Float(tile.y) + 0.5 - geometry[1]
    return dr.fma(geometry[3], dy, dx), dy


def raw_alphas(geometry: list[Any], s: Any, t: Any, recurrence: bool) -> list[Any]:
    """opacity * exp(-sigma) at the tile's 16 pixels, row by row; `s`, `t` as `offsets` gives them.

    Along a row and down the first column the Gaussian's ratio of neighbours is itself geometric, so two
    multiplications a pixel replace an exponential.
    """
    _, _, a, h, d, log_opacity = geometry[:6]
    if not recurrence:
        values = []
        for k in range(PIXELS):
            row = float(k // TILE)
            x, y = dr.fma(h, row, s + float(k % TILE)), t + row
            values.append(dr.exp2(log_opacity - dr.fma(a * x, x, d * y * y)))
        return values
    ah = a * h
    corner = dr.exp2(log_opacity - dr.fma(a * s, s, d * t * t))
    right = dr.exp2(-a * dr.fma(2.0, s, 1.0))
    down = dr.exp2(-dr.fma(ah, dr.fma(2.0, s, h), d * dr.fma(2.0, t, 1.0)))
    bend_x, bend_y, twist = dr.exp2(-2.0 * a), dr.exp2(-2.0 * dr.fma(ah, h, d)), dr.exp2(-2.0 * ah)
    values = []
    for row in range(TILE):
        value, ratio = corner, right
        for column in range(TILE):
            values.append(value)
            if column < TILE - 1:
                value = value * ratio
                ratio = ratio * bend_x
        if row < TILE - 1:
            corner, down, right = corner * down, down * bend_y, right * twist
    return values


def all_done(be: Backend, transmittances: list[Any]) -> Any:
    """Whether every pixel of the tile has stopped; a stopped pixel carries its transmittance negated."""
    combined = bits_of(be, transmittances[0])
    for transmittance in transmittances[1:]:
        combined &= bits_of(be, transmittance)
    return combined >= 0x80000000


def read_features(be: Backend, records: Any, splat: Any, count: int) -> list[Any]:
    """The first `count` features of a record."""
    size = power_of_two(count)
    ratio = RECORD // size
    return packet(be, records, ratio * splat + ratio // 2, size)[:count]


@dataclass(frozen=True)
class Blended:
    """Image of one chunk of features."""

    features: Any  # [H * W * F]
    transmittance: Any  # [H * W], what is left behind the splats
    end: Any  # [tiles] one past the last list entry that was looked at
    order: Any  # [tiles] lane order by that work, for the backward pass


def blend(be: Backend, records: Any, lists: TileLists, features: int, settings: Settings) -> Blended:
    """Blend `features` features of each record, front to back."""
    J = be.plain
    tile = tile_of(be, lists.order, lists, settings)
    pixels = tile.pixels()
    recurrence = settings.eps2d >= RECURRENCE_EPS2D

    def body(k: Any, transmittances: list[Any], sums: list[Any]) -> tuple[Any, list[Any], list[Any]]:
        splat = dr.gather(J.UInt32, lists.ids, k)
        geometry = packet(be, records, 2 * splat, 8)
        values = read_features(be, records, splat, features)
        alphas = raw_alphas(geometry, *offsets(be, tile, geometry), recurrence)
        transmittances, sums = list(transmittances), list(sums)
        for p, raw in enumerate(alphas):
            alpha = dr.select(raw < c.ALPHA_MAX, raw, c.ALPHA_MAX)
            alpha = dr.select(raw < c.ALPHA_MIN, 0.0, alpha)
            t = transmittances[p]
            after = dr.fma(-alpha, t, t)
            alive = after > c.T_MIN
            weight = dr.select(alive, alpha * t, 0.0)
            transmittances[p] = dr.select(alive, after, -dr.abs(t))
            for f, value in enumerate(values):
                sums[p * features + f] = dr.fma(weight, value, sums[p * features + f])
        return k + 1, transmittances, sums

    start = [dr.select(inside, J.Float(1.0), J.Float(-1.0)) for _, inside in pixels]
    k, transmittances, sums = dr.while_loop(
        (tile.first, start, [J.Float(0) for _ in range(PIXELS * features)]),
        lambda k, transmittances, sums: (k < tile.last) & ~all_done(be, transmittances),
        body,
        mode="symbolic",
    )
    size = settings.width * settings.height
    image, left = dr.empty(J.Float, size * features), dr.empty(J.Float, size)
    for p, (index, inside) in enumerate(pixels):
        write(left, dr.abs(transmittances[p]), index, inside)
        for f in range(features):
            write(image, sums[p * features + f], index * features + f, inside)
    end = dr.empty(J.UInt32, lists.tiles)
    write(end, k, tile.index)
    dr.eval(image, left, end)
    i = dr.arange(J.UInt32, lists.tiles)
    return Blended(image, left, end, lane_order(be, end - dr.gather(J.UInt32, lists.start, i), lists.tiles))
