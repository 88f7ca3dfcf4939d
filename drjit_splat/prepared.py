"""Geometry worked out once, colours and opacities many times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import _core
from ._autograd import stack
from ._backend import backend_of, exclusive, flat
from ._call import INPUTS, Call
from ._compile import outside_graphs
from ._gradients import arrays_of
from ._harmonics import colors_seen_from
from ._inputs import Splats, check_finite, check_shapes, finish
from ._meta import Meta, describe
from ._project import Arrays
from ._settings import Options, Settings


@dataclass(frozen=True)
class Prepared:
    """Projection, depth order and tile lists of fixed splats before fixed cameras; made by `prepare`."""

    splats: Splats  # float32; the colours are a placeholder
    settings: Settings
    adaptive: bool  # whether the lists hold for any opacities
    traces: tuple[_core.Trace, ...]  # one a camera, without images

    @outside_graphs
    @exclusive
    def shade(
        self, colors: Tensor, opacities: Tensor | None = None, backgrounds: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Meta]:
        """Render with other colours, and other opacities if `prepare` was told so.

        Args:
            colors: [N, D], or [N, K, D] harmonics, or a set for each camera, as `rasterization` takes them.
            opacities: [N] in [0, 1]; by default those that `prepare` was given.
            backgrounds: [C, D] colours behind the splats.

        Returns:
            What `rasterization` returns with `packed=False`, differentiable in the three tensors.

        Raises:
            ValueError: a tensor has a wrong shape, holds a NaN or an infinity, or the opacities may not change.
        """
        if opacities is not None and not self.adaptive:
            raise ValueError("opacities were fixed by prepare(); pass opacities_change=True there")
        given = replace(self.splats, colors=colors, backgrounds=backgrounds)
        if opacities is not None:
            given = replace(given, opacities=opacities)
        check_shapes(given, self.settings)
        check_finite(colors=colors, opacities=given.opacities)
        with torch.autocast(colors.device.type, enabled=False):
            single = given.to(torch.float32)
            images, coverages, traces = [], [], []
            for i, trace in enumerate(self.traces):
                values = single.colors_of(i, self.settings)
                if self.settings.sh_degree is not None:
                    values = colors_seen_from(values, single.means, single.viewmats[i], self.settings.sh_degree)
                holder: list[_core.Trace] = []
                sums, coverage = _Shade.apply(trace, holder, values, single.opacities)
                background = None if single.backgrounds is None else single.backgrounds[i]
                images.append(finish(sums, coverage, background, self.settings))
                coverages.append(coverage)
                traces.append(holder[0])
        call = Call(backend_of(colors.device), self.settings, (), len(traces), traces=traces)
        meta = describe(call, len(single.means), single.means.device)
        return stack(images).to(colors.dtype), stack(coverages).to(colors.dtype), meta


@outside_graphs
@exclusive
def prepare(
    means: Tensor,  # [N, 3]
    quats: Tensor | None,  # [N, 4]
    scales: Tensor | None,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    *,
    opacities_change: bool = False,
    covars: Tensor | None = None,  # [N, 3, 3]
    radial_coeffs: Tensor | None = None,  # [C, 4]
    options: Options | None = None,
    **arguments: Any,
) -> Prepared:
    """Do everything that colours cannot change, for `Prepared.shade` to reuse.

    The arguments that are not listed are those of `rasterization`; they get no gradients.

    Args:
        opacities_change: make lists that hold for any opacities, at the price of longer ones.
        arguments: `near_plane`, `far_plane`, `radius_clip`, `eps2d`, `sh_degree`, `render_mode` (with colours),
            `rasterize_mode`, `camera_model` and `semantics` of `rasterization`.

    Raises:
        ValueError, TypeError, MemoryError, RuntimeError: as `rasterization` does.
    """
    options = options or Options()
    if opacities_change:
        options = replace(options, opacity_extent=False)
    settings = Settings.of(width, height, options, **arguments)
    if not settings.has_colors:
        raise ValueError(f"render_mode must render colours, not {settings.render_mode!r}: nothing else can be shaded")
    if means.ndim > 2:
        raise ValueError(f"means must have the shape [N, 3], not {list(means.shape)}: prepare each of a batch")
    n = len(means)
    placeholder = means.new_zeros((n, 1) if settings.sh_degree is None else (n, (settings.sh_degree + 1) ** 2, 1))
    if covars is not None:
        quats = scales = None
    given = Splats(means, quats, scales, opacities, placeholder, viewmats, Ks, None, covars, radial_coeffs)
    check_shapes(given, settings)
    plain: dict[str, Any] = {k: None if t is None else t.detach().contiguous() for k, t in vars(given).items()}
    single = Splats(**plain).to(torch.float32)
    be = backend_of(means.device)
    traces = []
    for i in range(len(viewmats)):
        radial = None if single.radial_coeffs is None else single.radial_coeffs[i]
        per_splat = (single.means, single.quats, single.scales, single.covars, single.opacities)
        inputs = (*per_splat, single.viewmats[i], single.Ks[i], radial)
        trace = _core.Trace(be, settings)
        if n:
            flattened = tuple(None if t is None else flat(be.plain.Float, t) for t in inputs)
            trace = _core.geometry(be, arrays_of(n, 0, flattened), settings, 0)
        if trace.projected is not None and trace.projected.nonfinite:
            check_finite(**{k: t for k, t in zip(INPUTS, inputs, strict=False) if t is not None})
        traces.append(trace)
    return Prepared(single, settings, opacities_change, tuple(traces))


def _colors_only(be: Any, colors: Tensor, opacities: Tensor) -> Arrays:
    flat_colors, flat_opacities = flat(be.plain.Float, colors), flat(be.plain.Float, opacities)
    return Arrays(len(colors), colors.shape[1], None, None, None, None, flat_opacities, flat_colors, None, None)


class _Shade(torch.autograd.Function):
    """colors, opacities -> sums, coverage, over prepared geometry."""

    @staticmethod
    def forward(
        ctx: Any, base: _core.Trace, holder: list[_core.Trace], colors: Tensor, opacities: Tensor
    ) -> tuple[Tensor, ...]:
        """Blend; `holder` receives the trace with the image."""
        trace = _core.Trace(base.be, base.settings, base.projected, base.lists)
        features = colors.shape[1] + int(base.settings.has_depth)
        if trace.lists is not None and trace.projected is not None:
            arrays = _colors_only(trace.be, colors, opacities)
            seen = arrays.opacities
            if base.settings.antialiased:
                seen = trace.projected.compensation * seen
            _core.shade(trace, arrays.colors, colors.shape[1], features, seen, fresh=True)
        holder.append(trace)
        height, width = base.settings.height, base.settings.width
        *chunks, covered = trace.image()
        if covered is None:
            sums, coverage = colors.new_zeros(height, width, features), colors.new_zeros(height, width, 1)
        else:
            sums = torch.cat([chunk.torch().view(height, width, -1) for chunk in chunks], -1)
            coverage = covered.torch().view(height, width, 1)
        ctx.trace = trace
        ctx.save_for_backward(colors, opacities, sums, coverage)
        return sums, coverage

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx: Any, grad_sums: Tensor, grad_coverage: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the colours and opacities; the projection has no adjoint here."""
        colors, opacities = ctx.saved_tensors[:2]
        trace: _core.Trace = ctx.trace
        _, _, colors_asked, opacities_asked = ctx.needs_input_grad
        if trace.lists is None:
            return None, None, torch.zeros_like(colors), torch.zeros_like(opacities)
        kind = trace.be.plain.Float
        g = _core.backward(
            trace,
            _colors_only(trace.be, colors.detach().contiguous(), opacities.detach().contiguous()),
            [flat(kind, grad_sums[..., chunk.first : chunk.first + chunk.count]) for chunk in trace.chunks],
            flat(kind, grad_coverage),
            _core.Wanted(shape=False, opacities=opacities_asked, colors=colors_asked, camera=False),
        )
        grad_colors = None if g.colors is None else g.colors.torch().view(colors.shape)
        grad_opacities = None if g.inputs.opacities is None else g.inputs.opacities.torch().view(opacities.shape)
        return None, None, grad_colors, grad_opacities
