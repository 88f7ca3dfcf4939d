"""The rasterizer on Dr.Jit arrays, differentiable by `dr.backward`; needs no torch."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from . import _core
from ._backend import Backend, backend_named
from ._cameras import check_cameras
from ._compat import settings_of
from ._harmonics_drjit import colors_seen_from
from ._project import Arrays
from ._settings import Options, Settings
from .constants import MAX_CHECKED

_NAMES = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks", "radial_coeffs")


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
            _report_first_bad(self.tensors)
        if coverage is None:
            return dr.zeros(self.kind, (height, width, features)), dr.zeros(self.kind, (height, width, 1))
        sums = dr.empty(be.plain.Float, height * width * features)
        pixel = dr.arange(be.plain.UInt32, height * width)
        for chunk in self.trace.chunks:
            for f in range(chunk.count):
                value = dr.gather(be.plain.Float, chunk.image.features, chunk.count * pixel + f)
                dr.scatter(sums, value, features * pixel + chunk.first + f, mode=dr.ReduceMode.Permute)
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
        view, K = dr.zeros(be.plain.Float, 16), dr.zeros(be.plain.Float, 9)
        twelve = dr.arange(be.plain.UInt32, 12)
        dr.scatter(view, dr.gather(be.plain.Float, total, twelve), twelve)
        dr.scatter(K, dr.gather(be.plain.Float, total, be.plain.UInt32(12, 13, 14, 15)), be.plain.UInt32(0, 4, 2, 5))
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


def _report_first_bad(tensors: dict[str, Any]) -> None:
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        values = tensor.numpy()
        for index in np.argwhere(~np.isfinite(values))[:1].tolist():
            raise ValueError(f"{name}{index} is {values[tuple(index)]}: every value must be finite in float32")


def _check(tensors: dict[str, Any], settings: Settings, backgrounds: Any | None) -> None:
    sizes: dict[str, int] = {}
    per_splat: tuple[int | str, ...] = ("N", "D") if settings.sh_degree is None else ("N", "K", "D")
    shapes: dict[str, tuple[int | str, ...]] = {
        "means": ("N", 3),
        "quats": ("N", 4),
        "scales": ("N", 3),
        "covars": ("N", 3, 3),
        "opacities": ("N",),
        "colors": per_splat,
        "viewmats": ("C", 4, 4),
        "Ks": ("C", 3, 3),
        "radial_coeffs": ("C", 4),
        "backgrounds": ("C", "D"),
    }
    needed = {"means", "opacities", "viewmats", "Ks"}
    needed |= {"covars"} if tensors["covars"] is not None else {"quats", "scales"}
    needed |= {"colors"} if settings.has_colors else set()
    for name, tensor in (tensors | {"backgrounds": backgrounds}).items():
        if tensor is None and name not in needed:
            continue
        if tensor is None or not dr.is_tensor_v(tensor) or not dr.is_float_v(tensor) or not dr.is_jit_v(tensor):
            raise ValueError(
                f"{name} must be a Dr.Jit tensor of a backend (drjit.llvm.ad.TensorXf), not {_kind(tensor)}"
            )
        wanted = "[" + ", ".join(str(s) for s in shapes[name]) + "]"
        matches = len(tensor.shape) == len(shapes[name]) and all(
            got == (sizes.setdefault(want, got) if isinstance(want, str) else want)
            for got, want in zip(tensor.shape, shapes[name], strict=True)
        )
        if not matches:
            raise ValueError(f"{name} must have the shape {wanted}, not {list(tensor.shape)}")
    if sizes["C"] < 1:
        raise ValueError("viewmats must hold at least one camera")
    if tensors["colors"] is not None and sizes["D"] < 1:
        raise ValueError("colors must have at least 1 channel, not 0")
    if settings.has_colors and settings.sh_degree is not None and sizes["K"] < (settings.sh_degree + 1) ** 2:
        least = (settings.sh_degree + 1) ** 2
        raise ValueError(f"colors has {sizes['K']} harmonics a channel; sh_degree {settings.sh_degree} needs {least}")
    if tensors["radial_coeffs"] is not None and settings.camera_model != "fisheye":
        raise ValueError(f"radial_coeffs is for fisheye lenses, not {settings.camera_model}; undistort the images")
    small = {name: tensors[name] for name in ("viewmats", "Ks", "radial_coeffs")} | {"backgrounds": backgrounds}
    if tensors["colors"] is not None and (settings.sh_degree is not None or sizes["D"] > MAX_CHECKED):
        small["colors"] = tensors["colors"]  # the projection kernel checks everything that it reads itself
    _report_first_bad({name: None if t is None else dr.detach(t) for name, t in small.items()})
    check_cameras(dr.detach(tensors["viewmats"]).numpy(), dr.detach(tensors["Ks"]).numpy())


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__name__}"


def rasterization(
    means: Any,  # [N, 3]
    quats: Any | None,  # [N, 4]
    scales: Any | None,  # [N, 3]
    opacities: Any,  # [N]
    colors: Any | None,  # [N, D] or [N, K, D]
    viewmats: Any,  # [C, 4, 4]
    Ks: Any,  # [C, 3, 3]
    width: int,
    height: int,
    *,
    backgrounds: Any | None = None,  # [C, D]
    covars: Any | None = None,  # [N, 3, 3]
    radial_coeffs: Any | None = None,  # [C, 4]
    options: Options | None = None,
    **arguments: Any,
) -> tuple[Any, Any]:
    """Render as `drjit_splat.rasterization` does; all arrays are float32 tensors of one Dr.Jit backend.

    Args:
        means: [N, 3]; this and the others as in `drjit_splat.rasterization`, without batch dimensions.
        quats: [N, 4].
        scales: [N, 3].
        opacities: [N].
        colors: [N, D], or harmonics [N, K, D] when `sh_degree` is given; None without colours.
        viewmats: [C, 4, 4].
        Ks: [C, 3, 3].
        width: pixels.
        height: pixels.
        backgrounds: [C, D].
        covars: [N, 3, 3].
        radial_coeffs: [C, 4], without gradients.
        options: accuracy and skips.
        arguments: `near_plane`, `far_plane`, `radius_clip`, `eps2d`, `sh_degree`, `render_mode`, `rasterize_mode`,
            `camera_model` and `semantics` of `drjit_splat.rasterization`; those of gsplat that change nothing.

    Returns:
        colors [C, H, W, D (+ 1 with a depth)] and alphas [C, H, W, 1], differentiable in reverse mode.

    Raises:
        ValueError: an argument has a wrong shape, type or value, or holds a NaN or an infinity.
        TypeError: there is no such argument.
        MemoryError: the splats cover more tiles than can be stored.
        RuntimeError: no LLVM library was found; the message says what to install.
    """
    settings = settings_of(width, height, options, arguments)
    if covars is not None:
        quats = scales = None
    values = (means, quats, scales, covars, opacities, colors, viewmats, Ks, radial_coeffs)
    tensors = dict(zip(_NAMES, values, strict=True))
    _check(tensors, settings, backgrounds)
    kind = type(means)
    images, coverages = [], []
    for i in range(viewmats.shape[0]):
        seen = colors
        if not settings.has_colors:
            seen = kind(dr.array_t(kind)(), (means.shape[0], 0))
        elif settings.sh_degree is not None:
            seen = colors_seen_from(colors, means, viewmats[i], settings.sh_degree)
        radial = None if radial_coeffs is None else dr.detach(radial_coeffs[i])
        one = tensors | {"colors": seen, "viewmats": viewmats[i], "Ks": Ks[i], "radial_coeffs": radial}
        try:
            sums, coverage = dr.custom(_Splat, settings, **one)
        except RuntimeError as error:  # Dr.Jit wraps whatever goes wrong inside a custom operation
            if isinstance(error.__cause__, (ValueError, MemoryError)):
                raise error.__cause__ from None
            raise
        images.append(_finish(sums, coverage, None if backgrounds is None else backgrounds[i], settings))
        coverages.append(coverage)
    return _stack(images), _stack(coverages)


def _finish(sums: Any, coverage: Any, background: Any | None, settings: Settings) -> Any:
    parts = []
    if settings.has_colors:
        color = sums[:, :, :-1] if settings.has_depth else sums
        if background is not None:
            color = color + (1 - coverage) * dr.reshape(background, (1, 1, -1))
        parts.append(color)
    if settings.has_depth:
        depth = sums[:, :, -1:]
        parts.append(depth / dr.select(coverage > 1e-10, coverage, 1e-10) if settings.expected_depth else depth)
    return parts[0] if len(parts) == 1 else dr.concat(parts, axis=2)


def _stack(parts: list[Any]) -> Any:
    grown: list[Any] = [dr.reshape(part, (1, *part.shape)) for part in parts]
    return grown[0] if len(grown) == 1 else dr.concat(grown, axis=0)
