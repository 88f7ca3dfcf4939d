"""One camera's image as one node of torch's autograd graph."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import _core
from ._backend import Backend, backend_of, exclusive, flat
from ._inputs import check_finite
from ._project import Arrays
from ._settings import Settings

INPUTS = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks")


def arrays_of(be: Backend, inputs: tuple[Tensor | None, ...]) -> Arrays:
    """Contiguous float32 tensors in the order of `INPUTS`, without copies."""
    means, quats, scales, covars, opacities, colors, view, K = (
        None if t is None else flat(be.plain.Float, t) for t in inputs
    )
    assert inputs[0] is not None and inputs[5] is not None
    return Arrays(len(inputs[0]), inputs[5].shape[1], means, quats, scales, covars, opacities, colors, view, K)


def image_of(trace: _core.Trace, features: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Sums [H, W, F] and coverage [H, W, 1] of a blended trace."""
    height, width = trace.settings.height, trace.settings.width
    if not trace.chunks:
        return torch.zeros(height, width, features, device=device), torch.zeros(height, width, 1, device=device)
    parts = [chunk.image.features.torch().view(height, width, chunk.count) for chunk in trace.chunks]
    sums = parts[0] if len(parts) == 1 else torch.cat(parts, -1)
    first = trace.chunks[0].image
    covered = 1 - first.transmittance.torch() if first.coverage is None else first.coverage.torch()
    return sums, covered.view(height, width, 1)


def split(be: Backend, trace: _core.Trace, gradient: Tensor) -> list[Any]:
    """The chunks' shares of the gradient [H, W, F] of the sums."""
    return [
        flat(be.plain.Float, gradient[..., chunk.first : chunk.first + chunk.count].contiguous())
        for chunk in trace.chunks
    ]


def render(inputs: tuple[Tensor | None, ...], settings: Settings) -> _core.Trace:
    """Trace of one image; `inputs` are contiguous float32 in the order of `INPUTS`.

    Raises:
        ValueError: a value that the projection reads is not finite.
    """
    assert inputs[0] is not None and inputs[5] is not None
    be = backend_of(inputs[0].device)
    if len(inputs[0]) == 0:
        return _core.Trace(be, settings)
    arrays = arrays_of(be, inputs)
    features = arrays.columns + int(settings.has_depth)
    trace = _core.geometry(be, arrays, settings, features)
    if trace.projected is not None and trace.projected.nonfinite:
        check_finite(**{k: t for k, t in zip(INPUTS, inputs, strict=True) if t is not None})
    if trace.lists is not None:
        _core.shade(trace, arrays.colors, arrays.columns, features)
    return trace


class Splat(torch.autograd.Function):
    """The eight `INPUTS` -> sums, coverage.

    The kernels on both sides carry no gradients of their own: backward reads what forward saved, so it may run twice
    (`retain_graph`), and tensors edited in between are noticed by their version counters.
    """

    @staticmethod
    def forward(ctx: Any, settings: Settings, holder: list[_core.Trace], *inputs: Tensor | None) -> tuple[Tensor, ...]:
        """Render; `holder` receives the trace."""
        plain = tuple(None if t is None else t.detach().contiguous() for t in inputs)
        trace = render(plain, settings)
        holder.append(trace)
        assert plain[0] is not None and plain[5] is not None
        sums, coverage = image_of(trace, plain[5].shape[1] + int(settings.has_depth), plain[0].device)
        ctx.trace = trace
        ctx.save_for_backward(*inputs, sums, coverage)
        return sums, coverage

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx: Any, grad_sums: Tensor, grad_coverage: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the eight tensors."""
        saved = tuple(None if t is None else t.detach().contiguous() for t in ctx.saved_tensors[:8])
        trace: _core.Trace = ctx.trace
        asked = ctx.needs_input_grad[2:]
        if trace.lists is None:
            zeros = (torch.zeros_like(t) if w and t is not None else None for t, w in zip(saved, asked, strict=True))
            return (None, None, *zeros)
        arrays = arrays_of(trace.be, saved)
        wanted = _core.Wanted(any(asked[:4]), asked[4], asked[5], asked[6] or asked[7])
        g = _core.backward(
            trace,
            arrays,
            split(trace.be, trace, grad_sums.contiguous()),
            flat(trace.be.plain.Float, grad_coverage.contiguous()),
            wanted,
        )
        view, K = (None, None) if g.inputs.camera is None else _camera(g.inputs.camera.torch().view(arrays.count, -1))
        found = (g.inputs.means, g.inputs.quats, g.inputs.scales, g.inputs.covars, g.inputs.opacities, g.colors)
        tensors = [None if a is None else a.torch() for a in found] + [view, K]
        shaped = (
            None if t is None or source is None or not w else t.view(source.shape)
            for t, source, w in zip(tensors, saved, asked, strict=True)
        )
        return (None, None, *shaped)


def _camera(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the view matrix and of K from those of every splat [N, 16]."""
    total = rows.sum(0, dtype=torch.float64).to(torch.float32)
    fx, fy, cx, cy = total[12:]
    zero = torch.zeros_like(fx)
    view = torch.cat([total[:12], total.new_zeros(4)]).view(4, 4)
    return view, torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, zero]).view(3, 3)
