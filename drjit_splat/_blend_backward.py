"""Adjoint of blending: replay each tile front to back and add up each splat's gradient."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import drjit as dr

from ._backend import RECORDINGS, TILE, Backend, add_packet, packet, power_of_two, recorded
from ._binning import TileLists, lane_order
from ._blend import (
    Blended,
    clamped_alpha,
    entries,
    offsets,
    raw_alphas,
    read_features,
    step,
    tile_of,
    uses_recurrence,
)
from ._project import RECORD
from ._settings import Settings

UNROLL = 2  # see `_blend.UNROLL`; the adjoint of one entry is long enough to hide its gathers
MOMENTS = 8  # sums of v, v s, v t, v s^2, v s t, v t^2 with v = alpha dL/dalpha, s = dx + h dy, t = dy; then, if they
# are asked for, of |v s| and |v (a h s + d t)|


def blend_backward(
    be: Backend,
    records: Any,
    lists: TileLists,
    blended: Blended,
    features: int,
    grad_features: Any,  # [H * W * F]
    grad_coverage: Any | None,  # [H * W]
    capacity: int,
    settings: Settings,
    absolute: bool = False,
) -> Any:
    """One chunk's gradients [capacity * RECORD], `capacity` >= N, laid out like the records: a splat's moments and then
    those of its features share a cache line. `absolute` asks for the last two moments.
    """
    key = (be, capacity, features, lists.columns, lists.rows, settings, absolute, dr.thread_count())
    order = lane_order(be, lists.lengths(be, blended.end), lists.columns, lists.rows)
    image = (blended.features, blended.transmittance, blended.end)
    return _recorded(*key)(records, lists.ids, lists.start, order, *image, grad_features, grad_coverage)


@lru_cache(maxsize=RECORDINGS)
def _recorded(
    be: Backend, capacity: int, features: int, columns: int, rows: int, settings: Settings, absolute: bool, threads: int
) -> Callable[..., Any]:
    """The kernel, traced at its first call; see `_blend._recorded`. Each thread adds to a copy of its own, so that the
    number of `threads` is part of the key.
    """

    def run(
        records: Any, ids: Any, start: Any, order: Any, image: Any, left: Any, end: Any, grad: Any, grad_left: Any
    ) -> Any:
        gradients = dr.zeros(be.plain.Float, capacity * RECORD)
        lists = TileLists(ids, start, order, columns, rows, settings.options.list_width)
        blended = Blended(image, left, None, end)
        _add_gradients(be, records, lists, blended, features, grad, grad_left, gradients, settings, absolute)
        dr.eval(gradients)
        return gradients

    return recorded(run)


def _add_gradients(
    be: Backend,
    records: Any,
    lists: TileLists,
    blended: Blended,
    features: int,
    grad_features: Any,
    grad_coverage: Any | None,
    gradients: Any,
    settings: Settings,
    absolute: bool,
) -> None:
    """Add the gradients to those given.

    `behind` starts as the gradient-weighted sum of everything in the pixel and loses each splat as it is passed,
    so that dL/dalpha needs neither a stored state nor a walk from the back:
    alpha dL/dalpha = w (c . g) - behind * alpha / (1 - alpha).
    """
    J = be.plain
    tile = tile_of(be, lists.order, lists, settings)
    stop = dr.gather(J.UInt32, blended.end, tile.index, tile.used)
    padded = power_of_two(features)
    ratio = RECORD // padded

    # -------------------- Read the image and its gradient --------------------
    image_gradients, behind, start = [], [], []
    for index, inside in tile.pixels():
        g = [dr.gather(J.Float, grad_features, index * features + f, inside) for f in range(features)]
        rest = J.Float(0)
        for f in range(features):
            rest = dr.fma(g[f], dr.gather(J.Float, blended.features, index * features + f, inside), rest)
        if grad_coverage is not None:
            left = dr.gather(J.Float, blended.transmittance, index, inside)
            rest = dr.fma(-left, dr.gather(J.Float, grad_coverage, index, inside), rest)
        image_gradients.append(g)
        behind.append(rest)
        start.append(dr.select(inside, J.Float(1.0), J.Float(-1.0)))

    # Loop variables, one of each a lane:
    #   k               place in the list of the first of the UNROLL entries of this turn
    #   transmittances  [16] in front of the entry, as in the forward pass (negative once the pixel has stopped)
    #   behind          [16] gradient-weighted sum of what lies behind the entries passed so far

    def body(k: Any, transmittances: list[Any], behind: list[Any]) -> tuple[Any, list[Any], list[Any]]:
        transmittances, behind = list(transmittances), list(behind)
        for j, splat in enumerate(entries(be, lists, k, stop, UNROLL)):
            # -------------------- Record --------------------
            active = k + j < stop
            geometry = packet(be, records, 2 * splat, 8, active)
            values = read_features(be, records, splat, features, active)
            s, t = offsets(be, tile, geometry)
            # -------------------- Replay each pixel and take its derivative by alpha --------------------
            by_value = [J.Float(0) for _ in range(features)]
            total = J.Float(0)
            slopes = []
            for p, raw in enumerate(raw_alphas(be, geometry, s, t, settings, active)):
                alpha = clamped_alpha(raw, settings)
                alive, weight, transmittances[p] = step(be, alpha, transmittances[p], settings)
                shade = values[0] * image_gradients[p][0]
                by_value[0] = dr.fma(weight, image_gradients[p][0], by_value[0])
                for f in range(1, features):
                    shade = dr.fma(values[f], image_gradients[p][f], shade)
                    by_value[f] = dr.fma(weight, image_gradients[p][f], by_value[f])
                shade *= weight
                behind[p] -= shade
                slope = dr.fma(-behind[p], alpha / (1.0 - alpha), shade)
                slopes.append(dr.select(alive & (raw < settings.alpha_max), slope, 0.0))
                total += weight
            # -------------------- Reduce over the tile and add to the splat's gradient --------------------
            blended_here = total > 0.0
            moments = _moments if uses_recurrence(settings) else _moments_pixel_by_pixel
            sums = moments(J, slopes, geometry[3], s, t)
            if absolute:
                sums[6:] = _absolute_moments(J, slopes, geometry, s, t)
            add_packet(be, gradients, sums, 2 * splat, blended_here)
            padding = [J.Float(0)] * (padded - features)
            add_packet(be, gradients, by_value + padding, ratio * splat + ratio // 2, blended_here)
        return k + UNROLL, transmittances, behind

    # -------------------- Loop up to the last entry that the forward pass looked at --------------------
    dr.while_loop((tile.first, start, behind), lambda k, t, r: k < stop, body, mode="symbolic")


def _moments(J: Any, slopes: list[Any], h: Any, s: Any, t: Any) -> list[Any]:
    """Moments in the splat's sheared coordinates (s, t at the tile's first pixel) from those over the 4x4 grid."""
    plain, by_x, by_xx = [], [], []
    for row in range(TILE):
        v = slopes[row * TILE : (row + 1) * TILE]
        plain.append(v[0] + v[1] + v[2] + v[3])
        by_x.append(v[1] + 2.0 * v[2] + 3.0 * v[3])
        by_xx.append(v[1] + 4.0 * v[2] + 9.0 * v[3])
    total = plain[0] + plain[1] + plain[2] + plain[3]
    y = plain[1] + 2.0 * plain[2] + 3.0 * plain[3]
    yy = plain[1] + 4.0 * plain[2] + 9.0 * plain[3]
    x = by_x[0] + by_x[1] + by_x[2] + by_x[3]
    xy = by_x[1] + 2.0 * by_x[2] + 3.0 * by_x[3]
    xx = by_xx[0] + by_xx[1] + by_xx[2] + by_xx[3]
    # Shear the grid, then move it to the splat's mean.
    xx = dr.fma(h, dr.fma(h, yy, 2.0 * xy), xx)
    xy, x = dr.fma(h, yy, xy), dr.fma(h, y, x)
    about_s, about_t = dr.fma(s, total, x), dr.fma(t, total, y)
    return [
        total,
        about_s,
        about_t,
        dr.fma(s, about_s + x, xx),
        dr.fma(s, about_t, dr.fma(t, x, xy)),
        dr.fma(t, about_t + y, yy),
        J.Float(0),
        J.Float(0),
    ]


def _absolute_moments(J: Any, slopes: list[Any], geometry: list[Any], s: Any, t: Any) -> list[Any]:
    """Sums of |v s| and |v (a h s + d t)|: what each pixel alone would move the mean by, up to a factor."""
    _, _, a, h, d = geometry[:5]
    by_x, by_y = J.Float(0), J.Float(0)
    for k, v in enumerate(slopes):
        row, column = divmod(k, TILE)
        x, y = dr.fma(h, float(row), s + float(column)), t + float(row)
        by_x += dr.abs(v * x)
        by_y += dr.abs(v * dr.fma(a * h, x, d * y))
    return [by_x, by_y]


def _moments_pixel_by_pixel(J: Any, slopes: list[Any], h: Any, s: Any, t: Any) -> list[Any]:
    """The same, from every pixel's own distance to the mean.

    Without a low-pass a splat may be a millionth of a pixel wide: squares about the tile's corner would lose it.
    """
    sums = [J.Float(0) for _ in range(MOMENTS)]
    for k, v in enumerate(slopes):
        row, column = divmod(k, TILE)
        x, y = dr.fma(h, float(row), s + float(column)), t + float(row)
        vx, vy = v * x, v * y
        for i, term in enumerate((v, vx, vy, vx * x, vx * y, vy * y)):
            sums[i] += term
    return sums
