"""Geometry worked out once, colours and opacities many times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import _core
from ._autograd import INPUTS, arrays_of, image_of, split
from ._backend import Backend, backend_of, exclusive, flat
from ._harmonics import colors_seen_from
from ._inputs import Splats, check_finite, check_shapes, finish
from ._meta import Meta, describe, stack
from ._project import Arrays
from ._settings import Options, Settings


@dataclass(frozen=True)
class Prepared:
    """Projection, depth order and tile lists of fixed splats before fixed cameras; made by `prepare`."""

    splats: Splats  # float32; the colours are a placeholder
    settings: Settings
    adaptive: bool  # whether the lists hold for any opacities
    traces: tuple[_core.Trace, ...]  # one a camera, without images

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
            What `rasterization` returns, differentiable in the three tensors.

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
        n = len(single.means)
        meta = describe(traces, n, single.means.device)
        return stack(images).to(colors.dtype), stack(coverages).to(colors.dtype), meta


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
    options: Options | None = None,
    **arguments: Any,
) -> Prepared:
    """Do everything that colours cannot change, for `Prepared.shade` to reuse.

    The arguments that are not listed are those of `rasterization`; they get no gradients.

    Args:
        opacities_change: make lists that hold for any opacities, at the price of longer ones.
        arguments: `near_plane`, `far_plane`, `radius_clip`, `eps2d`, `sh_degree`, `render_mode` (with colours),
            `rasterize_mode` and `semantics` of `rasterization`.

    Raises:
        ValueError, MemoryError, RuntimeError: as `rasterization` does.
    """
    options = options or Options()
    if opacities_change:
        options = replace(options, opacity_extent=False)
    settings = Settings(width, height, **arguments, options=options)
    if not settings.has_colors:
        raise ValueError(f"render_mode must render colours, not {settings.render_mode!r}: nothing else can be shaded")
    n = len(means)
    placeholder = means.new_zeros((n, 1) if settings.sh_degree is None else (n, (settings.sh_degree + 1) ** 2, 1))
    if covars is not None:
        quats = scales = None
    given = Splats(means, quats, scales, opacities, placeholder, viewmats, Ks, None, covars)
    check_shapes(given, settings)
    plain: dict[str, Any] = {k: None if t is None else t.detach().contiguous() for k, t in vars(given).items()}
    single = Splats(**plain).to(torch.float32)
    be = backend_of(means.device)
    tensors = (single.means, single.quats, single.scales, single.covars, single.opacities, means.new_zeros(n, 0))
    traces = []
    for i in range(len(viewmats)):
        inputs = (*tensors[:5], tensors[5].to(torch.float32), single.viewmats[i], single.Ks[i])
        trace = _core.Trace(be, settings)
        if n:
            trace = _core.geometry(be, arrays_of(be, inputs), settings, 0)
        if trace.projected is not None and trace.projected.nonfinite:
            check_finite(**{k: t for k, t in zip(INPUTS, inputs, strict=True) if t is not None})
        traces.append(trace)
    return Prepared(single, settings, opacities_change, tuple(traces))


def _colors_only(be: Backend, colors: Tensor, opacities: Tensor) -> Arrays:
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
        sums, coverage = image_of(trace, features, colors.device)
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
        g = _core.backward(
            trace,
            _colors_only(trace.be, colors.detach().contiguous(), opacities.detach().contiguous()),
            split(trace.be, trace, grad_sums.contiguous()),
            flat(trace.be.plain.Float, grad_coverage.contiguous()),
            _core.Wanted(False, opacities_asked, colors_asked, False),
        )
        grad_colors = None if g.colors is None else g.colors.torch().view(colors.shape)
        grad_opacities = None if g.inputs.opacities is None else g.inputs.opacities.torch().view(opacities.shape)
        return None, None, grad_colors, grad_opacities
