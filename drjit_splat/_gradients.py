"""Gradients of one call's tensors, image by image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from . import _core
from ._backend import Backend
from ._bridge import cross
from ._call import PER_SPLAT, Call
from ._project import Arrays
from ._project_backward import InputGradients, OutputGradients
from ._values import BETWEEN, packed, shape_of, unpacked, visible_rows


def arrays_of(count: int, columns: int, arrays: tuple[Any, ...]) -> Arrays:
    """Flat arrays in the order of `INPUTS`; the colours may be missing."""
    means, quats, scales, covars, opacities, view, K, radial, *colors = arrays
    return Arrays(
        count,
        columns,
        means,
        quats,
        scales,
        covars,
        opacities,
        colors[0] if colors else None,
        view,
        K,
        radial,
    )


def wanted_of(asked: tuple[bool, ...], batches: int, **more: bool) -> _core.Wanted:
    """What the adjoint must work out for an image when some inputs of the first node want gradients."""
    shape = any(w for k, w in enumerate(asked[: PER_SPLAT * batches]) if k % PER_SPLAT != 4)
    opacities = any(asked[4 : PER_SPLAT * batches : PER_SPLAT])
    camera = any(asked[PER_SPLAT * batches :])
    return _core.Wanted(shape=shape, opacities=opacities, camera=camera, **more)


def image_gradients(found: InputGradients) -> list[Any]:
    """In the order of the inputs of an image; the camera's are still those of every splat [N * 16]."""
    return [found.means, found.quats, found.scales, found.covars, found.opacities, found.camera]


@dataclass
class BlendGradients:
    """Gradients by way of the images."""

    inputs: list[Tensor | None]  # of the first node's inputs
    colors: list[Tensor | None]  # of each image's colours
    between: list[list[Tensor | None]]  # for each image of means2d, conics and depths, where somebody looks
    absolute: Tensor | None = None  # of means2d


def _camera(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the view matrix and of K from those of every splat [N, 16]."""
    total = rows.sum(0, dtype=torch.float64).to(torch.float32)
    fx, fy, cx, cy = total[12:]
    zero = torch.zeros_like(fx)
    view = torch.cat([total[:12], total.new_zeros(4)]).view(4, 4)
    return view, torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, zero]).view(3, 3)


class _Sums:
    """Gradients of the first node's inputs, added up over the images."""

    def __init__(self, call: Call, inputs: tuple[Tensor | None, ...]) -> None:
        self.call, self.inputs = call, inputs
        self.splats: list[Tensor | None] = [None] * (PER_SPLAT * call.batches)
        self.cameras: list[tuple[Tensor, Tensor]] = []

    def add(self, i: int, found: list[Tensor | None]) -> None:
        """Add what the kernels found for image `i`: `image_gradients` as flat tensors."""
        first = PER_SPLAT * (i // self.call.cameras)
        for k, gradient in enumerate(found[:PER_SPLAT]):
            source = self.inputs[first + k]
            if gradient is None or source is None:
                continue
            known = self.splats[first + k]
            gradient = gradient.view(source.shape)
            self.splats[first + k] = gradient if known is None else known + gradient
        rows = found[PER_SPLAT]
        device = self.inputs[-2].device  # type: ignore[union-attr]
        self.cameras.append(
            (torch.zeros(4, 4, device=device), torch.zeros(3, 3, device=device))
            if rows is None
            else _camera(rows.view(-1, 16))
        )

    def result(self, asked: tuple[bool, ...]) -> list[Tensor | None]:
        """One gradient an input, None where nobody asked."""
        views, Ks = (torch.stack(parts) for parts in zip(*self.cameras, strict=True))
        found = [*self.splats, views, Ks, None]
        pairs = zip(found, self.inputs, asked, strict=True)
        return [None if t is None or not w else (torch.zeros_like(t) if g is None else g) for g, t, w in pairs]


def blend_gradients(
    call: Call,
    inputs: tuple[Tensor | None, ...],
    colors: tuple[Tensor | None, ...],
    asked: tuple[bool, ...],
    colors_asked: bool,
    grad_sums: Tensor,
    grad_coverage: Tensor,
) -> BlendGradients:
    """Replay the blending of all images and what led to it."""
    looked = {name: name in call.looked for name in BETWEEN}
    wanted = wanted_of(asked, call.batches, colors=colors_asked, absolute=call.absgrad, **looked)
    sums = _Sums(call, inputs)
    result = BlendGradients([], [], [])
    absolute = []
    for i, trace in enumerate(call.traces):
        own = colors[i]
        assert own is not None
        n, columns = own.shape
        if trace.lists is None:
            sums.add(i, [None] * 6)
            result.colors.append(torch.zeros_like(own) if colors_asked else None)
            result.between.append([None] * 3)
            absolute.append(own.new_zeros(n, 2))
            continue
        chunks = [grad_sums[i, ..., ch.first : ch.first + ch.count].contiguous() for ch in trace.chunks]

        def kernels(be: Backend, *arrays: Any, trace: _core.Trace = trace, n: int = n, columns: int = columns) -> Any:
            inner = arrays_of(n, columns, arrays[:9])
            g = _core.backward(trace, inner, list(arrays[9:-1]), arrays[-1], wanted)
            o = g.outputs
            return [*image_gradients(g.inputs), g.colors, o.means2d, o.conics, o.depths, o.absolute]

        tensors = [*call.of_image(inputs, i), own if columns else None, *chunks, grad_coverage[i]]
        found = cross(call.be, kernels, tensors, call.wrapped)
        sums.add(i, found[:6])
        result.colors.append(None if found[6] is None else found[6].view(own.shape))
        result.between.append(found[7:10])
        absolute.append(own.new_zeros(n, 2) if found[10] is None else found[10].view(n, 2))
    result.inputs = sums.result(asked)
    if call.absgrad:
        shape = shape_of(call, len(absolute[0]), 2)
        result.absolute = packed(call, torch.stack(absolute), 2).reshape(shape)
    return result


def given_gradients(
    call: Call, shapes: tuple[torch.Size, ...], found: BlendGradients, device: torch.device
) -> tuple[Tensor, ...]:
    """Gradients of means2d, conics and depths; zeros that take no memory where nobody has looked."""
    written = []
    for k, (name, shape) in enumerate(zip(BETWEEN, shapes, strict=True)):
        if name not in call.looked or 0 in shape:
            written.append(torch.zeros((), device=device).expand(shape))
            continue
        n, size = len_of(call), BETWEEN[name]
        parts = [torch.zeros(n * size, device=device) if p[k] is None else p[k] for p in found.between]
        full = torch.stack([part.view(n, size) for part in parts if part is not None])
        written.append(packed(call, full, size).view(shape))
    return tuple(written)


def len_of(call: Call) -> int:
    """Number of splats of each element of the batch."""
    import drjit as dr

    projected = call.traces[0].projected
    return 0 if projected is None else dr.width(projected.depths)


def output_gradients(
    call: Call, inputs: tuple[Tensor | None, ...], columns: list[int], gradients: list[Tensor | None]
) -> list[Tensor | None]:
    """Gradients of the first node's inputs from some of means2d, conics and depths (None: zero)."""
    n = len_of(call)
    sums = _Sums(call, inputs)
    wanted = wanted_of(call.asked, call.batches, colors=False)
    full = [
        None if g is None else unpacked(call, g.to(torch.float32), size)
        for g, size in zip(gradients, BETWEEN.values(), strict=True)
    ]
    for i, trace in enumerate(call.traces):
        if trace.projected is None or not (wanted.shape or wanted.camera):
            sums.add(i, [None] * 6)
            continue

        def kernels(be: Backend, *arrays: Any, trace: _core.Trace = trace, i: int = i) -> Any:
            given = OutputGradients(*arrays[8:])
            inner = arrays_of(n, columns[i], arrays[:8])
            return image_gradients(_core.outputs_backward(trace, inner, given, wanted.camera))

        parts = [None if f is None else f[i].contiguous() for f in full]
        sums.add(i, cross(call.be, kernels, [*call.of_image(inputs, i), *parts], call.wrapped))
    return sums.result(call.asked)


def summed(a: list[Tensor | None], b: list[Tensor | None]) -> list[Tensor | None]:
    """Sums of gradients, of which any may be missing."""
    return [x if y is None else y if x is None else x + y for x, y in zip(a, b, strict=True)]


def sparse_rows(call: Call, found: list[Tensor | None]) -> list[Tensor | None]:
    """The same with the gradients of means, quats and scales as sparse tensors, rows of visible splats only."""
    rows = visible_rows(call).view(call.cameras, -1).any(0).nonzero()[:, 0]

    def sparse(gradient: Tensor | None) -> Tensor | None:
        if gradient is None:
            return None
        return torch.sparse_coo_tensor(
            rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False
        )

    return [sparse(g) if k < 3 else g for k, g in enumerate(found)]
