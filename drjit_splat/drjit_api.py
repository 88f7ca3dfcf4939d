"""The rasterizer on Dr.Jit arrays, differentiable by `dr.backward`; needs no torch."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

from . import _core
from ._backend import Backend, backend_named
from ._compat import settings_of
from ._drjit_inputs import check_arguments, report_first_bad
from ._harmonics_drjit import colors_seen_from
from ._project import Arrays
from ._settings import Options, Settings

_NAMES = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks", "radial_coeffs")
_PER_SPLAT = _NAMES[:6]


class _Splat(dr.CustomOp):  # type: ignore[misc]
    """Nine tensors of one camera -> sums [H, W, F], coverage [H, W, 1]."""

    def eval(
        self,
        settings: Settings,
        means: Any,
        quats: Any,
        scales: Any,
        covars: Any,
        opacities: Any,
        colors: Any,
        viewmats: Any,
        Ks: Any,
        radial_coeffs: Any,
    ) -> tuple[Any, Any]:
        """Render."""
        given = (means, quats, scales, covars, opacities, colors, viewmats, Ks, radial_coeffs)
        self.tensors = {k: None if t is None else dr.detach(t) for k, t in zip(_NAMES, given, strict=True)}
        self.kind = type(means)
        be = backend_named(dr.backend_v(self.kind) == dr.JitBackend.LLVM)
        self.arrays = _arrays(be, self.tensors)
        features = self.arrays.columns + int(settings.has_depth)
        height, width = settings.height, settings.width
        self.trace = _core.Trace(be, settings)
        *_, coverage = _core.render(self.trace, self.arrays) if self.arrays.count else [None]
        p = self.trace.projected
        if p is not None and p.nonfinite:
            report_first_bad(self.tensors)
        if coverage is None:
            return dr.zeros(self.kind, (height, width, features)), dr.zeros(self.kind, (height, width, 1))
        sums = dr.empty(be.plain.Float, height * width * features)
        pixel = dr.arange(be.plain.UInt32, height * width)
        for chunk in self.trace.chunks:
            for f in range(chunk.count):
                value = dr.gather(be.plain.Float, chunk.image.features, chunk.count * pixel + f)
                dr.scatter(sums, value, features * pixel + chunk.first + f, mode=dr.ReduceMode.Permute)
        dr.eval(sums)
        return (
            self.kind(_like(self.kind, sums), (height, width, features)),
            self.kind(_like(self.kind, coverage), (height, width, 1)),
        )

    def backward(self) -> None:
        """Hand back the gradients of the tensors."""
        trace, arrays, be = self.trace, self.arrays, self.trace.be
        if trace.lists is None:
            return
        outputs: Any = self.grad_out()
        grad_sums, grad_coverage = (_flat(be, g) for g in outputs)
        features = sum(chunk.count for chunk in trace.chunks)
        pixel = dr.arange(be.plain.UInt32, trace.settings.height * trace.settings.width)
        parts = []
        for chunk in trace.chunks:
            part = dr.empty(be.plain.Float, chunk.count * dr.width(pixel))
            for f in range(chunk.count):
                value = dr.gather(be.plain.Float, grad_sums, features * pixel + chunk.first + f)
                dr.scatter(part, value, chunk.count * pixel + f, mode=dr.ReduceMode.Permute)
            parts.append(part)
        dr.eval(parts)
        g = _core.backward(
            trace, arrays, parts, grad_coverage, _core.Wanted(shape=True, opacities=True, colors=True, camera=True)
        )
        total = dr.sum(be.plain.TensorXf(g.inputs.camera, (arrays.count, 16)), axis=0).array
        sixteen = dr.arange(be.plain.UInt32, 16)
        view = dr.gather(be.plain.Float, total, sixteen, sixteen < 12)
        places = be.plain.UInt32(12, 16, 14, 16, 13, 15, 16, 16, 16)  # of fx, cx, fy, cy; 16 stands for none
        K = dr.gather(be.plain.Float, total, places, places < 16)
        dr.eval(view, K)
        i = g.inputs
        found = (i.means, i.quats, i.scales, i.covars, i.opacities, g.colors, view, K, None)
        for name, gradient in zip(_NAMES, found, strict=True):
            tensor = self.tensors[name]
            if tensor is not None and gradient is not None and tensor.shape[-1]:
                self.set_grad_in(name, self.kind(_like(self.kind, gradient), tensor.shape))

    def forward(self) -> None:
        """Forward-mode derivatives are not available."""
        raise NotImplementedError("drjit_splat has reverse-mode derivatives only: use dr.backward")

    def name(self) -> str:
        """Label in Dr.Jit's graph output."""
        return "drjit_splat"


def _like(kind: Any, array: Any) -> Any:
    """A plain array in the (differentiable) array type behind a tensor type."""
    return dr.array_t(kind)(array)


def _flat(be: Backend, tensor: Any) -> Any:
    return be.plain.Float(dr.detach(tensor.array, False))


def _arrays(be: Backend, tensors: dict[str, Any]) -> Arrays:
    flat = {k: None if t is None else _flat(be, t) for k, t in tensors.items()}
    n, columns = tensors["means"].shape[0], tensors["colors"].shape[1]
    return Arrays(
        n,
        columns,
        flat["means"],
        flat["quats"],
        flat["scales"],
        flat["covars"],
        flat["opacities"],
        flat["colors"],
        flat["viewmats"],
        flat["Ks"],
        flat["radial_coeffs"],
    )


def rasterization(
    means: Any,  # [..., N, 3]
    quats: Any | None,  # [..., N, 4]
    scales: Any | None,  # [..., N, 3]
    opacities: Any,  # [..., N]
    colors: Any | None,  # [..., (C,) N, D] or [..., (C,) N, K, D]
    viewmats: Any,  # [..., C, 4, 4]
    Ks: Any,  # [..., C, 3, 3]
    width: int,
    height: int,
    *,
    backgrounds: Any | None = None,  # [..., C, D]
    covars: Any | None = None,  # [..., N, 3, 3]
    radial_coeffs: Any | None = None,  # [..., C, 4]
    options: Options | None = None,
    **arguments: Any,
) -> tuple[Any, Any]:
    """Render as `drjit_splat.rasterization` does; all arrays are float32 tensors of one Dr.Jit type.

    It cannot be part of a function under `drjit.freeze`: the length of the lists of splats must be read while it runs.
    Its own kernels are frozen already; freeze what comes before and after it.

    Args:
        means: [..., N, 3]; this and the others as in `drjit_splat.rasterization`.
        quats: [..., N, 4].
        scales: [..., N, 3].
        opacities: [..., N].
        colors: [..., N, D], or harmonics [..., N, K, D] when `sh_degree` is given, which may be without the batch's
            dimensions; a set for each camera where C comes before N; None without colours.
        viewmats: [..., C, 4, 4].
        Ks: [..., C, 3, 3].
        width: pixels.
        height: pixels.
        backgrounds: [..., C, D].
        covars: [..., N, 3, 3].
        radial_coeffs: [..., C, 4], without gradients.
        options: accuracy and skips.
        arguments: `near_plane`, `far_plane`, `radius_clip`, `eps2d`, `sh_degree`, `render_mode`, `rasterize_mode`,
            `camera_model` and `semantics` of `drjit_splat.rasterization`; those of gsplat that change nothing.

    Returns:
        colors [..., C, H, W, D (+ 1 with a depth)] and alphas [..., C, H, W, 1], differentiable in reverse mode.

    Raises:
        ValueError: an argument has a wrong shape, type or value, or holds a NaN or an infinity.
        TypeError: there is no such argument.
        MemoryError: the splats cover more tiles than can be stored.
        RuntimeError: no LLVM library was found (the message says what to install), or a function is being frozen.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        raise RuntimeError(
            "drjit_api.rasterization cannot be recorded by drjit.freeze: it reads the length of its lists as it runs; "
            "call it between frozen functions (its own kernels are frozen already)"
        )
    settings = settings_of(width, height, options, arguments)
    if covars is not None:
        quats = scales = None
    values = (means, quats, scales, covars, opacities, colors, viewmats, Ks, radial_coeffs)
    tensors = dict(zip(_NAMES, values, strict=True)) | {"backgrounds": backgrounds}
    batch = check_arguments(tensors, settings)
    images, coverages = [], []
    cameras = viewmats.shape[-3]
    parts = _parts(tensors, batch, settings)
    for index in range(math.prod(batch) * cameras):
        element = {name: part[index // cameras if name in _PER_SPLAT else index] for name, part in parts.items()}
        image, coverage = _one(element, index % cameras, settings)
        images.append(image)
        coverages.append(coverage)
    shape = (*batch, cameras)
    return _stack(images, shape), _stack(coverages, shape)


def _parts(tensors: dict[str, Any], batch: tuple[int, ...], settings: Settings) -> dict[str, list[Any]]:
    """The tensors of each element of the batch, or of each image."""
    count = math.prod(batch)
    images, found = count * tensors["viewmats"].shape[-3], {}
    for name, tensor in tensors.items():
        shared = name == "colors" and tensor is not None and settings.sh_degree is not None and tensor.ndim == 3
        rows = count if name in _PER_SPLAT else images
        if tensor is None or shared or (not batch and name in _PER_SPLAT):
            found[name] = [tensor] * rows
        else:
            own = tensor.shape[len(batch) + (name not in _PER_SPLAT) :]
            found[name] = [_part(tensor, index, own) for index in range(rows)]
    return found


def _part(tensor: Any, index: int, shape: tuple[int, ...]) -> Any:
    """Part `index` of a tensor that consists of parts of this shape.

    Indexing the tensor would do the same, but with several threads Dr.Jit 1.5.0 now and then loses a part's gradient
    where the mode is left to it.
    """
    size, flat = math.prod(shape), dr.array_t(tensor)
    places = dr.arange(dr.uint32_array_t(flat), size) + dr.opaque(dr.uint32_array_t(flat), index * size)
    return type(tensor)(dr.gather(flat, tensor.array, places, mode=dr.ReduceMode.Permute), shape)


def _one(tensors: dict[str, Any], camera: int, settings: Settings) -> tuple[Any, Any]:
    """Image [H, W, F] and coverage [H, W, 1] of one camera."""
    means, colors, viewmat = tensors["means"], tensors["colors"], tensors["viewmats"]
    kind = type(means)
    if not settings.has_colors:
        seen = kind(dr.array_t(kind)(), (means.shape[0], 0))
    else:
        seen = colors if colors.ndim == (2 if settings.sh_degree is None else 3) else colors[camera]
        if settings.sh_degree is not None:
            seen = colors_seen_from(seen, means, viewmat, settings.sh_degree)
    given = {name: tensors[name] for name in _NAMES} | {"colors": seen}
    if tensors["radial_coeffs"] is not None:
        given["radial_coeffs"] = dr.detach(tensors["radial_coeffs"])
    try:
        sums, coverage = dr.custom(_Splat, settings, **given)
    except RuntimeError as error:  # Dr.Jit wraps whatever goes wrong inside a custom operation
        if isinstance(error.__cause__, (ValueError, MemoryError)):
            raise error.__cause__ from None
        raise
    return _finish(sums, coverage, tensors["backgrounds"], settings), coverage


def _finish(sums: Any, coverage: Any, background: Any | None, settings: Settings) -> Any:
    """Sums [H, W, F] over the background; the depth channel, when there is one, is the last and has none."""
    kind = type(sums)
    features = sums.shape[2]
    if settings.has_colors and background is not None:
        values = background.array
        if settings.has_depth:
            values = dr.concat((values, dr.zeros(dr.array_t(kind), 1)))
        sums = sums + (1 - coverage) * kind(values, (1, 1, features))
    if settings.expected_depth:
        place = dr.arange(dr.uint32_array_t(dr.array_t(kind)), features)
        last = dr.mask_t(kind)(place == features - 1, (1, 1, features))
        sums = dr.select(last, sums / dr.select(coverage > 1e-10, coverage, 1e-10), sums)
    return sums


def _stack(parts: list[Any], shape: tuple[int, ...]) -> Any:
    grown: list[Any] = [dr.reshape(part, (1, *part.shape)) for part in parts]
    whole = grown[0] if len(grown) == 1 else dr.concat(grown, axis=0)
    return dr.reshape(whole, (*shape, *parts[0].shape))
