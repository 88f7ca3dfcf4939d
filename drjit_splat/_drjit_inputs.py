"""Checks of the arguments of the interface without torch; the twin of `_inputs`."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from ._cameras import check_cameras
from ._settings import Settings
from .constants import MAX_CHECKED

Size = int | str


def check_arguments(tensors: dict[str, Any], settings: Settings) -> tuple[int, ...]:
    """Check tensors by name (None where one is not given); `backgrounds` is among them.

    Returns:
        The sizes of the batch dimensions.

    Raises:
        ValueError: an argument has a wrong type, shape or value, or holds a NaN or an infinity; the message names it.
    """
    needed = {"means", "opacities", "viewmats", "Ks"}
    needed |= {"covars"} if tensors["covars"] is not None else {"quats", "scales"}
    needed |= {"colors"} if settings.has_colors else set()
    _check_kinds(tensors, needed)
    batch = tuple(tensors["means"].shape[:-2]) if tensors["means"].ndim > 2 else ()
    if math.prod(batch) == 0:
        raise ValueError(f"means must have batch dimensions of at least 1, not {list(batch)}")
    sizes: dict[str, int] = {}
    shapes: dict[str, tuple[Size, ...]] = {
        "means": (*batch, "N", 3),
        "quats": (*batch, "N", 4),
        "scales": (*batch, "N", 3),
        "covars": (*batch, "N", 3, 3),
        "opacities": (*batch, "N"),
        "viewmats": (*batch, "C", 4, 4),
        "Ks": (*batch, "C", 3, 3),
        "colors": (),
        "radial_coeffs": (*batch, "C", 4),
        "backgrounds": (*batch, "C", "D"),
    }
    for name, shape in shapes.items():
        if tensors[name] is not None:
            _expect(name, tensors[name], shape or _color_shape(tensors["colors"], settings, batch), sizes)
    _check_sizes(tensors, settings, sizes)
    small = {name: tensors[name] for name in ("viewmats", "Ks", "radial_coeffs", "backgrounds")}
    if tensors["colors"] is not None and (settings.sh_degree is not None or sizes["D"] > MAX_CHECKED):
        small["colors"] = tensors["colors"]  # the projection kernel checks everything that it reads itself
    report_first_bad({name: None if t is None else dr.detach(t) for name, t in small.items()})
    check_cameras(dr.detach(tensors["viewmats"]).numpy(), dr.detach(tensors["Ks"]).numpy())
    return batch


def report_first_bad(tensors: dict[str, Any]) -> None:
    """Raise ValueError naming the first value that is not finite."""
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        values = tensor.numpy()
        for index in np.argwhere(~np.isfinite(values))[:1].tolist():
            raise ValueError(f"{name}{index} is {values[tuple(index)]}: every value must be finite in float32")


def _check_kinds(tensors: dict[str, Any], needed: set[str]) -> None:
    """All must be float32 tensors of the type of `means`, which decides where and whether derivatives are kept."""
    for name, tensor in tensors.items():
        if tensor is None and name not in needed:
            continue
        if tensor is None or not dr.is_tensor_v(tensor) or not dr.is_float_v(tensor) or not dr.is_jit_v(tensor):
            raise ValueError(
                f"{name} must be a Dr.Jit tensor of a backend (drjit.llvm.ad.TensorXf), not {_kind(tensor)}"
            )
        if dr.type_v(tensor) != dr.VarType.Float32:
            raise ValueError(f"{name} must hold float32 numbers (TensorXf), not {_kind(tensor)}")
        if type(tensor) is not type(tensors["means"]):
            raise ValueError(
                f"{name} is a {_kind(tensor)}, but means is a {_kind(tensors['means'])}: use one type for all"
            )


def _color_shape(colors: Any, settings: Settings, batch: tuple[int, ...]) -> tuple[Size, ...]:
    """[..., (C,) N, D], harmonics [..., (C,) N, K, D], or [N, K, D] for a whole batch."""
    own: tuple[Size, ...] = ("N", "D") if settings.sh_degree is None else ("N", "K", "D")
    if settings.sh_degree is not None and colors.ndim == 3:
        return own
    return (*batch, "C", *own) if colors.ndim == len(batch) + len(own) + 1 else (*batch, *own)


def _expect(name: str, tensor: Any, shape: tuple[Size, ...], sizes: dict[str, int]) -> None:
    matches = len(tensor.shape) == len(shape) and all(
        got == (sizes.setdefault(want, got) if isinstance(want, str) else want)
        for got, want in zip(tensor.shape, shape, strict=True)
    )
    if not matches:
        wanted = "[" + ", ".join(str(s) for s in shape) + "]"
        known = ", ".join(f"{key} = {value}" for key, value in sizes.items())
        raise ValueError(f"{name} must have the shape {wanted} ({known}), not {list(tensor.shape)}")


def _check_sizes(tensors: dict[str, Any], settings: Settings, sizes: dict[str, int]) -> None:
    if sizes["C"] < 1:
        raise ValueError("viewmats must hold at least one camera")
    if tensors["colors"] is not None and sizes["D"] < 1:
        raise ValueError("colors must have at least 1 channel, not 0")
    if settings.has_colors and settings.sh_degree is not None and sizes["K"] < (settings.sh_degree + 1) ** 2:
        least = (settings.sh_degree + 1) ** 2
        raise ValueError(f"colors has {sizes['K']} harmonics a channel; sh_degree {settings.sh_degree} needs {least}")
    radial = tensors["radial_coeffs"]
    if radial is not None and settings.camera_model != "fisheye":
        raise ValueError(f"radial_coeffs is for fisheye lenses, not {settings.camera_model}; undistort the images")
    if radial is not None and dr.grad_enabled(radial):
        raise ValueError("radial_coeffs gets no gradient; detach it")


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__name__}"
