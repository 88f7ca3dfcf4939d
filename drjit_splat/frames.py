"""Pictures for the eye: eight bits a channel, without gradients, and in two steps so that frames overlap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from . import _core
from ._backend import RECORDINGS, TILE, Backend, backend_named, exclusive, larger, recorded, smaller, undisturbed, write
from ._binning import TileLists, build, empty
from ._blend import accumulate
from ._project import Arrays, Queued
from ._settings import Options, Settings
from .constants import T_CLOSING
from .profiling import stage

CHANNELS = 3
OPTIONS = Options(list_width=2)  # the quickest without the adjoint
WORDS = TILE * CHANNELS // 4  # 32-bit words that hold the bytes of a tile's row


@dataclass(frozen=True)
class Frame:
    """An image of bytes whose kernel may still run."""

    words: Any  # whole tiles, row by row, each pixel's three bytes after those of its left neighbour
    work: Any  # [tiles] list entries that each tile took
    width: int
    height: int

    def numpy(self) -> NDArray[np.uint8]:
        """The bytes [H, W, 3]; waits for them."""
        rows, columns = -(-self.height // TILE), -(-self.width // TILE)
        # The array may be a view of memory that Dr.Jit uses again.
        pixels = np.array(self.words.numpy(), copy=True).view(np.uint8)
        return pixels.reshape(rows * TILE, columns * TILE, CHANNELS)[: self.height, : self.width]


@dataclass(frozen=True)
class ProjectedFrame:
    """Splats whose projection is queued; made by `project_frame`."""

    settings: Settings
    queued: Queued

    @exclusive
    @undisturbed
    def blend(self, background: Any, like: Frame | None = None) -> Frame:
        """Wait for the projection and begin to blend.

        Args:
            background: [3] in [0, 1], a flat Dr.Jit array.
            like: an earlier frame of this size, best the last of the film. What its tiles took tells which of this
                one's should be blended side by side; it changes no pixel.

        Raises:
            ValueError: a value of a splat or the camera is not finite.
            MemoryError: the splats cover more tiles than can be stored.
        """
        be = backend_named(True)
        projected = self.queued.result()
        if projected.nonfinite:
            raise ValueError("every value of the splats and the camera must be finite in float32")
        work = None if like is None else like.work
        lists = build(be, projected, self.settings, work) if projected.pairs else empty(be, self.settings)
        kernel = _blend_kernel(be, lists.columns, lists.rows, self.settings)
        with stage("blend"):
            words, work = kernel(projected.records, lists.ids, lists.start, lists.order, background)
        return Frame(words, work, self.settings.width, self.settings.height)


@exclusive
@undisturbed
def project_frame(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    view: Any,
    intrinsics: Any,
    width: int,
    height: int,
    closing: float = T_CLOSING,
) -> ProjectedFrame:
    """Begin to project N >= 1 splats, for a picture as `rasterization` makes it, rounded to bytes.

    What follows needs the number of tiles that the splats cover. Whatever else is queued before `blend` asks for it,
    such as the picture before this one, is done meanwhile.

    Args:
        means: [N * 3], like all arrays flat and of the type `drjit.llvm.Float`.
        quats: [N * 4] wxyz.
        scales: [N * 3].
        opacities: [N].
        colors: [N * 3].
        view: [16] world to camera.
        intrinsics: [9].
        width: pixels.
        height: pixels.
        closing: transmittance at which a pixel is closed: the splat that would bring it down to this gets all that is
            left, and what lies behind is skipped. A channel, in [0, 1], is off by at most `closing` times the largest
            difference of colours. 0 stops as `rasterization` does.

    Raises:
        ValueError: `closing` is not in [0, 1).
        RuntimeError: no LLVM library was found; the message says what to install.
    """
    be = backend_named(True)
    if not 0 <= closing < 1:
        raise ValueError(f"closing must lie in [0, 1), not {closing}")
    options = replace(OPTIONS, transmittance_min=closing) if closing else OPTIONS
    settings = Settings(width, height, options=options, closing=closing > 0)
    settings.check()
    project = _projection(be, dr.width(opacities), settings)
    with stage("project"):
        return ProjectedFrame(settings, Queued(*project(means, quats, scales, opacities, colors, view, intrinsics)))


@lru_cache(maxsize=RECORDINGS)
def _projection(be: Backend, count: int, settings: Settings) -> Callable[..., Any]:
    """The projection of `count` splats, traced at its first call."""

    def run(means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, view: Any, intrinsics: Any) -> Any:
        arrays = Arrays(count, CHANNELS, means, quats, scales, None, opacities, colors, view, intrinsics)
        return tuple(vars(_core.queue(be, arrays, settings, CHANNELS)).values())

    return recorded(run)


@lru_cache(maxsize=RECORDINGS)
def _blend_kernel(be: Backend, columns: int, rows: int, settings: Settings) -> Callable[..., Any]:
    """The kernel of one image size, traced at its first call; see `_blend._recorded`."""

    def run(records: Any, ids: Any, start: Any, order: Any, background: Any) -> Any:
        return _blend_to_bytes(
            be, records, TileLists(ids, start, order, columns, rows, settings.options.list_width), background, settings
        )

    return recorded(run)


def _blend_to_bytes(be: Backend, records: Any, lists: TileLists, background: Any, settings: Settings) -> Any:
    J = be.plain
    tile, state, last = accumulate(be, records, lists, CHANNELS, settings)
    behind = [dr.gather(J.Float, background, J.UInt32(f)) for f in range(CHANNELS)]
    words = dr.empty(J.UInt32, lists.tiles * TILE * WORDS)
    # A tile's place in rows of `columns` tiles: from the index of its first word in the picture.
    stride = dr.opaque(J.UInt32, lists.columns * WORDS)
    first = tile.y * stride + tile.x // TILE * WORDS
    for row in range(TILE):
        pixels = state[row * TILE : (row + 1) * TILE]
        values = [dr.fma(dr.abs(pixel[0]), behind[f], pixel[1 + f]) for pixel in pixels for f in range(CHANNELS)]
        levels = [J.UInt32(dr.round(255.0 * smaller(larger(value, 0.0), 1.0))) for value in values]
        for word in range(WORDS):
            a, b, c, d = levels[4 * word : 4 * word + 4]
            write(words, a | (b << 8) | (c << 16) | (d << 24), first + (row * stride + word), tile.used)
    work = dr.empty(J.UInt32, lists.tiles)
    write(work, last - tile.first, tile.index, tile.used)
    dr.eval(words, work)
    return words, work
