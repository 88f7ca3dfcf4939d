"""One call as two nodes of torch's autograd graph: splats -> means on the images -> images.

Both are computed at once, and so are their adjoints: what passes between them on the way back is a note where to find
the result. Only when somebody has looked at the means (or conics, depths) in between are they and their gradients
written out, so that the graph is as gsplat's and costs nothing.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import _core
from ._backend import exclusive
from ._bridge import cross
from ._call import INPUTS, Call, Pending
from ._gradients import (
    arrays_of,
    blend_gradients,
    given_gradients,
    output_gradients,
    sparse_rows,
    summed,
)
from ._inputs import check_finite
from ._values import empty_outputs


def _contiguous(tensors: tuple[Tensor | None, ...]) -> tuple[Tensor | None, ...]:
    return tuple(None if t is None else t.detach().contiguous() for t in tensors)


def render(call: Call, inputs: tuple[Tensor | None, ...], colors: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Sums [I, H, W, F] and coverage [I, H, W, 1] of all images; fills `call.traces`.

    Raises:
        ValueError: a value that the projection reads is not finite.
    """
    s = call.settings
    sums, coverages = [], []
    for i in range(call.count):
        tensors = call.of_image(inputs, i)
        trace = _core.Trace(call.be, s)
        call.traces.append(trace)
        features = colors[i].shape[1] + int(s.has_depth)
        n, columns = colors[i].shape
        if n:
            found = cross(
                call.be,
                lambda be, *arrays, trace=trace, n=n, columns=columns: _core.render(
                    trace, arrays_of(n, columns, arrays)
                ),
                [*tensors, colors[i] if columns else None],
                call.wrapped,
            )
            if trace.projected is not None and trace.projected.nonfinite:
                named = zip(INPUTS, [*tensors, colors[i]], strict=True)
                check_finite(**{name: t for name, t in named if t is not None})
        if trace.lists is None:
            sums.append(colors[i].new_zeros(s.height, s.width, features))
            coverages.append(colors[i].new_zeros(s.height, s.width, 1))
            continue
        *chunks, coverage = found
        parts = [part.view(s.height, s.width, -1) for part in chunks if part is not None]
        assert coverage is not None
        sums.append(parts[0] if len(parts) == 1 else torch.cat(parts, -1))
        coverages.append(coverage.view(s.height, s.width, 1))
    return stack(sums), stack(coverages)


def stack(parts: list[Tensor]) -> Tensor:
    """Images in one tensor, without a copy when there is one."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


class Project(torch.autograd.Function):
    """For each element of the batch means, quats, scales, covars and opacities, then viewmats [I, 4, 4], Ks [I, 3, 3]
    and lens coefficients -> means2d, conics and depths, whose values are written when somebody looks.
    """

    @staticmethod
    def forward(ctx: Any, call: Call, colors: list[Tensor], *inputs: Tensor | None) -> tuple[Tensor, ...]:
        """Render; the images go to the second node by way of `call`."""
        call.images = render(call, _contiguous(inputs), colors)
        call.asked = ctx.needs_input_grad[2:]
        ctx.call = call
        ctx.columns = [c.shape[1] for c in colors]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs)
        return empty_outputs(call, colors[0].device, len(colors[0]))

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Gradients of the inputs: those by way of the images, and those of what else depends on the results."""
        call: Call = ctx.call
        inputs = _contiguous(ctx.saved_tensors)
        pending, call.pending = call.pending, None
        if pending is not None and pending.task != torch._C._current_graph_task_id():
            pending = None  # left by a pass that never came here
        found: list[Tensor | None] = [None] * len(inputs) if pending is None else pending.inputs
        extra: list[Tensor | None] = []
        for k, gradient in enumerate(gradients):
            given = None if pending is None else pending.given[k]
            if gradient is None or (given is not None and gradient.data_ptr() == given.data_ptr()):
                extra.append(None)
            else:
                extra.append(gradient if given is None else gradient - given)
        if any(e is not None for e in extra):
            found = summed(found, output_gradients(call, inputs, ctx.columns, extra))
        if call.sparse:
            found = sparse_rows(call, found)
        asked = ctx.needs_input_grad[2:]
        return (None, None, *(g if w else None for g, w in zip(found, asked, strict=True)))


class Composite(torch.autograd.Function):
    """means2d, conics, depths and the colours of each image -> sums [I, H, W, F], coverage [I, H, W, 1].

    The kernels on both sides carry no gradients of their own: backward reads what forward saved, so it may run twice
    (`retain_graph`), and tensors edited in between are noticed by their version counters.
    """

    @staticmethod
    def forward(
        ctx: Any,
        call: Call,
        inputs: tuple[Tensor | None, ...],
        means2d: Tensor,
        conics: Tensor,
        depths: Tensor,
        *colors: Tensor,
    ) -> tuple[Tensor, ...]:
        """The images that the first node has made; `inputs` are that node's."""
        assert call.images is not None
        (sums, coverage), call.images = call.images, None
        ctx.call = call
        ctx.means2d = means2d if call.absgrad else None
        ctx.shapes = (means2d.shape, conics.shape, depths.shape)
        ctx.save_for_backward(*(None if t is None else t.detach() for t in inputs), *colors, sums, coverage)
        return sums, coverage

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx: Any, grad_sums: Tensor, grad_coverage: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the colours; those of the splats wait in `call.pending` for the first node."""
        call: Call = ctx.call
        saved = _contiguous(ctx.saved_tensors[:-2])
        inputs, colors = saved[: -call.count], saved[-call.count :]
        through, colors_asked = ctx.needs_input_grad[2], ctx.needs_input_grad[5:]
        asked = call.asked if through else (False,) * len(inputs)
        result = blend_gradients(
            call, inputs, colors, asked, any(colors_asked), grad_sums.contiguous(), grad_coverage.contiguous()
        )
        given: tuple[Tensor | None, ...] = (None, None, None)
        if through:
            written = given_gradients(call, ctx.shapes, result, grad_sums.device)
            call.pending = Pending(torch._C._current_graph_task_id(), written, result.inputs)
            given = written
        if ctx.means2d is not None:
            ctx.means2d.absgrad = result.absolute
        wanted = (g if w else None for g, w in zip(result.colors, colors_asked, strict=True))
        return (None, None, *given, *wanted)


def rasterize(call: Call, inputs: tuple[Tensor | None, ...], colors: list[Tensor]) -> tuple[Tensor, ...]:
    """Sums, coverage and the results in between: means2d, conics, depths."""
    between = Project.apply(call, [c.detach().contiguous() for c in colors], *inputs)
    sums, coverage = Composite.apply(call, inputs, *between, *colors)
    return sums, coverage, *between
