"""One camera's image as one node of torch's autograd graph."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import _adjoint, _lists, _project
from ._backend import Backend, backend_of, flat, power_of_two
from ._blend import Blended, blend
from ._blend_backward import MOMENTS, blend_backward
from ._inputs import Settings, check_finite

CHUNK = 8  # most features that one blending pass carries (16 sums each live in the lane's registers)


@dataclass
class Trace:
    """What the forward kernels leave for the adjoint and for `meta`."""

    be: Backend
    projected: _project.Projected | None = None
    lists: _lists.TileLists | None = None
    chunks: list[tuple[int, int, Any, Blended]] = field(default_factory=list)  # first feature, count, records, image

    @property
    def passed_over(self) -> int:
        """List entries that were never looked at because their tile was already opaque."""
        if self.lists is None or self.projected is None:
            return 0
        # Every chunk takes the same decisions, so the first speaks for all.
        seen = dr.sum(self.lists.lengths(self.be, self.chunks[0][3].end))
        return self.projected.pairs - int(seen[0])


def _more_records(be: Backend, projected: _project.Projected, colors: Tensor, first: int, count: int) -> Any:
    """Records with the geometry of `projected` and the features from `first` on; past the colours comes the depth."""
    J = be.plain
    n, columns = colors.shape
    source, i = flat(J.Float, colors), dr.arange(J.UInt32, n)
    values = [
        dr.gather(J.Float, source, columns * i + f) if f < columns else projected.depths
        for f in range(first, first + count)
    ]
    values += [J.Float(0)] * (power_of_two(count) - count)
    records = dr.empty(J.Float, n * _project.RECORD)
    _project.write_packet(be, records, _project.packet(be, projected.records, 2 * i, 8), 2 * i)
    ratio = _project.RECORD // len(values)
    _project.write_packet(be, records, values, ratio * i + ratio // 2)
    dr.eval(records)
    return records


def render(inputs: tuple[Tensor, ...], viewmat: Tensor, K: Tensor, settings: Settings) -> tuple[Tensor, Tensor, Trace]:
    """Sums [H, W, F], coverage [H, W, 1] and trace; `inputs` are contiguous float32."""
    device = inputs[0].device
    trace = Trace(backend_of(device))
    be = trace.be
    height, width = settings.height, settings.width
    columns = inputs[4].shape[1]
    features = columns + int(settings.has_depth)
    sums = torch.zeros(height, width, features, device=device)
    coverage = torch.zeros(height, width, 1, device=device)
    if len(inputs[0]) == 0:
        return sums, coverage, trace
    camera = _project.read_camera(be, viewmat, K, settings)
    p = _project.run(be, inputs, features, min(features, CHUNK), camera, settings)
    if p.nonfinite:
        check_finite(**dict(zip(("means", "quats", "scales", "opacities", "colors"), inputs, strict=True)))
    trace.projected = p
    if p.pairs == 0:
        return sums, coverage, trace
    trace.lists = _lists.build(be, p, settings)
    for first in range(0, features, CHUNK):
        count = min(CHUNK, features - first)
        records = p.records if first == 0 else _more_records(be, p, inputs[4], first, count)
        image = blend(be, records, trace.lists, count, settings)
        trace.chunks.append((first, count, records, image))
        part = image.features.torch().view(height, width, count)
        if count == features:
            sums = part
        else:
            sums[..., first : first + count] = part
    return sums, 1 - trace.chunks[0][3].transmittance.torch().view(height, width, 1), trace


class Splat(torch.autograd.Function):
    """means, quats, scales, opacities, colors, viewmat, K -> sums, coverage.

    The kernels on both sides carry no gradients of their own: backward reads what forward saved, so it may run twice
    (`retain_graph`), and tensors edited in between are noticed by their version counters.
    """

    @staticmethod
    def forward(ctx: Any, settings: Settings, holder: list[Trace], *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Render; `holder` receives the trace."""
        arrays = tuple(t.detach().contiguous() for t in inputs)
        sums, coverage, trace = render(arrays[:5], arrays[5], arrays[6], settings)
        holder.append(trace)
        ctx.settings, ctx.trace = settings, trace
        ctx.save_for_backward(*inputs, sums, coverage)
        return sums, coverage

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_sums: Tensor, grad_coverage: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the seven tensors."""
        saved = tuple(t.detach().contiguous() for t in ctx.saved_tensors[:7])
        trace: Trace = ctx.trace
        wanted = ctx.needs_input_grad[2:]
        if trace.lists is None or trace.projected is None:
            return (None, None, *(torch.zeros_like(t) if w else None for t, w in zip(saved, wanted, strict=True)))
        grads = _backward(trace, saved, grad_sums.contiguous(), grad_coverage.contiguous(), ctx.settings, wanted)
        return (None, None, *(g if w else None for g, w in zip(grads, wanted, strict=True)))


def _capacity(n: int) -> int:
    """A size of at least `n`, at most a quarter more, that takes few values.

    Expanded scatter-additions compile the size of their target into the kernel, so exact sizes would recompile the
    backward pass for every new number of splats.
    """
    step = max(256, power_of_two(n) // 8)
    return -(-n // step) * step


def _backward(
    trace: Trace, saved: tuple[Tensor, ...], grad_sums: Tensor, grad_coverage: Tensor, settings: Settings, wanted: Any
) -> tuple[Tensor | None, ...]:
    be, p, lists = trace.be, trace.projected, trace.lists
    assert p is not None and lists is not None
    J = be.plain
    n, columns = saved[4].shape
    features = columns + int(settings.has_depth)
    moments = dr.zeros(J.Float, _capacity(n) * MOMENTS)
    grad_colors = None
    grad_depth = None
    parts = []
    for first, count, records, image in trace.chunks:
        chunk = grad_sums if count == features else grad_sums[..., first : first + count].contiguous()
        values = dr.zeros(J.Float, _capacity(n) * power_of_two(count))
        blend_backward(
            be,
            records,
            lists,
            image,
            count,
            flat(J.Float, chunk),
            flat(J.Float, grad_coverage) if first == 0 else None,
            moments,
            values,
            settings,
        )
        dr.eval(moments, values)
        size = power_of_two(count)
        if first + count > columns:
            i = dr.arange(J.UInt32, n)
            grad_depth = dr.gather(J.Float, values, size * i + count - 1)
        parts.append(values.torch().view(-1, size)[:n, : min(count, columns - first)])
    if wanted[4]:
        grad_colors = torch.cat(parts, dim=1)
    camera = _project.read_camera(be, saved[5], saved[6], settings)
    with_camera = wanted[5] or wanted[6]
    g = _adjoint.projection_adjoint(be, saved, p.records, p.visible, moments, grad_depth, camera, settings, with_camera)
    grad_view = grad_K = None
    if g.camera is not None:
        total = g.camera.torch().view(n, _adjoint.CAMERA).sum(0, dtype=torch.float64).to(torch.float32)
        grad_view = torch.cat([total[:12], total.new_zeros(4)]).view(4, 4)
        fx, fy, cx, cy = total[12:]
        zero = torch.zeros_like(fx)
        grad_K = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, zero]).view(3, 3)
    return (
        g.means.torch().view(n, 3),
        g.quats.torch().view(n, 4),
        g.scales.torch().view(n, 3),
        g.opacities.torch().view(n),
        grad_colors,
        grad_view,
        grad_K,
    )
