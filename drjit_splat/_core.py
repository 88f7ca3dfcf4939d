"""One camera's image and its adjoint on Dr.Jit arrays; nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr

from . import _binning, _project
from . import constants as c
from ._backend import Backend, larger, packet, power_of_two, undisturbed, write, write_packet
from ._blend import Blended, blend
from ._blend_backward import blend_backward
from ._project import RECORD, Arrays
from ._project_backward import (
    InputGradients,
    OutputGradients,
    opacity_adjoint,
    output_gradients,
    projection_adjoint,
    seeds_of_moments,
    seeds_of_outputs,
)
from ._settings import Settings
from .profiling import stage

CHUNK = 8  # most features that one blending pass carries (16 sums each live in the lane's registers)


@dataclass(frozen=True)
class Chunk:
    """A few consecutive features and their image."""

    first: int
    count: int
    records: Any
    image: Blended


@dataclass
class Trace:
    """What the forward kernels leave for the adjoint and for `meta`; no lists where nothing is visible."""

    be: Backend
    settings: Settings
    projected: _project.Projected | None = None
    lists: _binning.TileLists | None = None
    chunks: list[Chunk] = field(default_factory=list)

    def skipped(self) -> dict[str, int]:
        """How many pairs and tiles the skips saved, besides the culled splats."""
        count = self.settings.options.count_skips
        if self.lists is None or self.projected is None or not self.chunks:
            return {"occluded_pairs": 0} | ({"box_pairs": 0, "empty_tiles": 0} if count else {})
        lengths = self.lists.lengths(self.be)
        # Every chunk takes the same decisions, so the first speaks for all.
        unseen: Any = dr.sum(lengths - self.lists.lengths(self.be, self.chunks[0].image.end))
        found = {"occluded_pairs": int(unseen[0])}
        if count:
            found["box_pairs"] = self.projected.box_pairs - self.projected.pairs
            empty: Any = dr.count(lengths == 0)
            found["empty_tiles"] = int(empty[0])
        return found

    def image(self) -> list[Any]:
        """Features [H * W * F] of every chunk, then the coverage [H * W]; nothing where nothing is visible."""
        if not self.chunks:
            return [None]
        first = self.chunks[0].image
        covered = 1 - first.transmittance if first.coverage is None else first.coverage
        return [*(chunk.image.features for chunk in self.chunks), covered]


@undisturbed
def render(trace: Trace, arrays: Arrays) -> list[Any]:
    """Render N >= 1 splats into an empty trace and return its image, unless `projected.nonfinite` says otherwise."""
    features = arrays.columns + int(trace.settings.has_depth)
    seen = geometry(trace.be, arrays, trace.settings, features)
    trace.projected, trace.lists = seen.projected, seen.lists
    if trace.lists is not None:
        shade(trace, arrays.colors, arrays.columns, features)
    return trace.image()


@undisturbed
def queue(be: Backend, arrays: Arrays, settings: Settings, features: int) -> _project.Queued:
    """Begin to project N >= 1 splats."""
    camera = _project.read_camera(be, arrays, settings)
    return _project.run(be, arrays, features, min(features, CHUNK), camera, settings)


@undisturbed
def geometry(be: Backend, arrays: Arrays, settings: Settings, features: int) -> Trace:
    """Project N >= 1 splats and list them tile by tile; check `projected.nonfinite` before going on."""
    trace = Trace(be, settings)
    with stage("project"):
        trace.projected = queue(be, arrays, settings, features).result()
    if trace.projected.pairs and not trace.projected.nonfinite:
        trace.lists = _binning.build(be, trace.projected, settings)
    return trace


@undisturbed
def shade(
    trace: Trace, colors: Any, columns: int, features: int, opacities: Any | None = None, fresh: bool = False
) -> None:
    """Blend `features` features: `columns` colours [N * columns] and, past them, the depth; adds to `trace.chunks`.

    The first chunk's records come from the projection unless `fresh` asks to write them from `colors` and `opacities`.
    """
    be, p, lists = trace.be, trace.projected, trace.lists
    assert p is not None and lists is not None
    for first in range(0, features, CHUNK):
        count = min(CHUNK, features - first)
        with stage("records"):
            own = first > 0 or fresh
            records = _records(be, p, colors, columns, first, count, opacities) if own else p.records
        with stage("blend"):
            trace.chunks.append(Chunk(first, count, records, blend(be, records, lists, count, trace.settings)))


def _records(
    be: Backend, p: _project.Projected, colors: Any, columns: int, first: int, count: int, opacities: Any | None
) -> Any:
    """Records with the projection's geometry and the features from `first` on; past the colours comes the depth."""
    J = be.plain
    n = dr.width(p.depths)
    i = dr.arange(J.UInt32, n)
    values = [
        dr.gather(J.Float, colors, columns * i + f) if f < columns else p.depths for f in range(first, first + count)
    ]
    values += [J.Float(0)] * (power_of_two(count) - count)
    kept = packet(be, p.records, 2 * i, 8)
    if opacities is not None:
        kept[5] = dr.log2(larger(opacities, c.OPACITY_FLOOR))
    records = dr.empty(J.Float, n * RECORD)
    write_packet(be, records, kept, 2 * i)
    ratio = RECORD // len(values)
    write_packet(be, records, values, ratio * i + ratio // 2)
    dr.eval(records)
    return records


@dataclass(frozen=True)
class Wanted:
    """Which gradients somebody asked for."""

    shape: bool  # means, quats, scales or covars
    opacities: bool
    colors: bool
    camera: bool
    means2d: bool = False  # what the projection makes of the splats
    conics: bool = False
    depths: bool = False
    absolute: bool = False  # the means' absolute gradients, added up pixel by pixel


@dataclass(frozen=True)
class Gradients:
    """Flat Dr.Jit arrays, None where nothing was asked for."""

    inputs: InputGradients
    colors: Any | None  # [N * D]
    outputs: OutputGradients


_capacities: set[int] = set()


def capacity(n: int) -> int:
    """A size of at least `n` for sums over splats, from as few values as possible.

    Expanded scatter-additions compile the size of their target into the kernel, so exact sizes would recompile the
    backward pass for every new number of splats. A size in use serves down to half of it.
    """
    fitting = [size for size in _capacities if n <= size <= 2 * n + 256]
    if not fitting:
        step = max(256, power_of_two(n) // 8)
        fitting = [-(-n // step) * step]
        _capacities.update(fitting)
    return min(fitting)


@undisturbed
def backward(
    trace: Trace, arrays: Arrays, grad_features: list[Any], grad_coverage: Any | None, wanted: Wanted
) -> Gradients:
    """Gradients of the inputs from those of every chunk's features [H * W * count] and of the coverage [H * W]."""
    be, p, lists = trace.be, trace.projected, trace.lists
    assert p is not None and lists is not None
    J = be.plain
    n, columns = arrays.count, arrays.columns
    i = dr.arange(J.UInt32, n)
    sums = []
    grad_depth = None
    grad_colors = dr.empty(J.Float, n * columns) if wanted.colors else None
    for chunk, gradient in zip(trace.chunks, grad_features, strict=True):
        with stage("blend backward"):
            coverage = grad_coverage if chunk.first == 0 else None
            target = blend_backward(
                be,
                chunk.records,
                lists,
                chunk.image,
                chunk.count,
                gradient,
                coverage,
                capacity(n),
                trace.settings,
                wanted.absolute,
            )
        sums.append(target)
        size = power_of_two(chunk.count)
        ratio = RECORD // size
        values = packet(be, target, ratio * i + ratio // 2, size)
        for k in range(chunk.count):
            feature = chunk.first + k
            if feature == columns:
                grad_depth = values[k]
            elif grad_colors is not None:
                write(grad_colors, values[k], columns * i + feature)
        if grad_colors is not None:
            dr.schedule(grad_colors)
    with stage("projection backward"):
        if wanted.shape or wanted.camera:
            camera = _project.read_camera(be, arrays, trace.settings)
            seeds = seeds_of_moments(be, p.records, sums, i)
            inputs = projection_adjoint(be, arrays, p.visible, seeds, grad_depth, camera, trace.settings, wanted.camera)
        else:
            inputs = opacity_adjoint(be, arrays.opacities, p.visible, sums, wanted.opacities)
        dr.eval(grad_colors)
    outputs = output_gradients(
        be, p.records, p.visible, sums, means2d=wanted.means2d, conics=wanted.conics, absolute=wanted.absolute
    )
    return Gradients(inputs, grad_colors, replace(outputs, depths=grad_depth if wanted.depths else None))


@undisturbed
def outputs_backward(trace: Trace, arrays: Arrays, given: OutputGradients, with_camera: bool) -> InputGradients:
    """Gradients of the inputs from those of what the projection makes of N >= 1 splats."""
    be, p = trace.be, trace.projected
    assert p is not None
    i = dr.arange(be.plain.UInt32, arrays.count)
    camera = _project.read_camera(be, arrays, trace.settings)
    seeds = seeds_of_outputs(be, p.records, given, i)
    return projection_adjoint(be, arrays, p.visible, seeds, given.depths, camera, trace.settings, with_camera)
