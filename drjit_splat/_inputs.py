"""Checks of the public arguments, shared by the kernels and the oracle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ._cameras import check_cameras
from ._settings import Settings

Size = int | str


@dataclass(frozen=True)
class Splats:
    """The tensor arguments of one call; `...` stands for any batch dimensions."""

    means: Tensor  # [..., N, 3]
    quats: Tensor | None  # [..., N, 4], with scales; None with covars
    scales: Tensor | None  # [..., N, 3]
    opacities: Tensor  # [..., N]
    colors: Tensor | None  # [..., (C,) N, D] or harmonics [..., (C,) N, K, D] or [N, K, D]; None without colours
    viewmats: Tensor  # [..., C, 4, 4]
    Ks: Tensor  # [..., C, 3, 3]
    backgrounds: Tensor | None = None  # [..., C, D]
    covars: Tensor | None = None  # [..., N, 3, 3]
    radial_coeffs: Tensor | None = None  # [..., C, 4]

    @property
    def batch(self) -> torch.Size:
        """Sizes of the batch dimensions."""
        return self.means.shape[:-2]

    def to(self, dtype: torch.dtype) -> Splats:
        """All tensors in `dtype`."""
        converted: dict[str, Any] = {k: None if t is None else t.to(dtype) for k, t in vars(self).items()}
        return Splats(**converted)

    def batches(self, settings: Settings) -> list[Splats]:
        """One for each element of the batch, without batch dimensions."""
        dims = len(self.batch)
        if dims == 0:
            return [self]
        count = math.prod(self.batch)
        parts: dict[str, Any] = {}
        for name, tensor in vars(self).items():
            shared = name == "colors" and tensor is not None and settings.sh_degree is not None and tensor.ndim == 3
            if tensor is None or shared:
                parts[name] = [tensor] * count
            else:
                parts[name] = tensor.reshape(count, *tensor.shape[dims:]).unbind(0)
        return [Splats(**{name: values[b] for name, values in parts.items()}) for b in range(count)]

    def colors_of(self, camera: int, settings: Settings) -> Tensor:
        """Colours or harmonics that camera `camera` sees, without batch dimensions."""
        assert self.colors is not None
        shared = 2 if settings.sh_degree is None else 3
        return self.colors if self.colors.ndim == shared else self.colors[camera]


def _expect(name: str, tensor: Tensor | None, shape: tuple[Size, ...], sizes: dict[str, int]) -> None:
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name} must be a torch tensor, not {type(tensor).__name__}")
    wanted = "[" + ", ".join(str(s) for s in shape) + "]"
    if not tensor.is_floating_point():
        raise ValueError(f"{name} must hold floating point numbers, not {tensor.dtype}")
    if tensor.ndim != len(shape):
        raise ValueError(f"{name} must have the shape {wanted}, not {list(tensor.shape)}")
    for got, want in zip(tensor.shape, shape, strict=True):
        expected = sizes.setdefault(want, got) if isinstance(want, str) else want
        if got != expected:
            known = ", ".join(f"{key} = {value}" for key, value in sizes.items())
            raise ValueError(f"{name} must have the shape {wanted} ({known}), not {list(tensor.shape)}")


def _check_colors(splats: Splats, settings: Settings, batch: tuple[Size, ...], sizes: dict[str, int]) -> None:
    if splats.colors is None and not settings.has_colors:
        return
    own: tuple[Size, ...] = ("N", "D") if settings.sh_degree is None else ("N", "K", "D")
    dims = splats.colors.ndim if isinstance(splats.colors, Tensor) else 0
    if dims == len(batch) + len(own) + 1:
        own = ("C", *own)
    if settings.sh_degree is None or dims != len(own):  # harmonics may be shared by the whole batch
        own = (*batch, *own)
    _expect("colors", splats.colors, own, sizes)
    if settings.sh_degree is not None and sizes["K"] < (settings.sh_degree + 1) ** 2:
        needed = (settings.sh_degree + 1) ** 2
        raise ValueError(f"colors has {sizes['K']} harmonics a channel; sh_degree {settings.sh_degree} needs {needed}")
    if sizes["D"] < 1:
        raise ValueError("colors must have at least 1 channel, not 0")


def check_shapes(splats: Splats, settings: Settings) -> None:
    """Raise ValueError naming the first argument whose shape, type or value is not allowed."""
    sizes: dict[str, int] = {}
    batch: tuple[Size, ...] = ()
    if isinstance(splats.means, Tensor) and splats.means.ndim > 2:
        batch = tuple(splats.batch)
    if math.prod(int(size) for size in batch) == 0:
        raise ValueError(f"means must have batch dimensions of at least 1, not {list(batch)}")
    _expect("means", splats.means, (*batch, "N", 3), sizes)
    if splats.covars is None:
        _expect("quats", splats.quats, (*batch, "N", 4), sizes)
        _expect("scales", splats.scales, (*batch, "N", 3), sizes)
    else:
        _expect("covars", splats.covars, (*batch, "N", 3, 3), sizes)
    _expect("opacities", splats.opacities, (*batch, "N"), sizes)
    _expect("viewmats", splats.viewmats, (*batch, "C", 4, 4), sizes)
    _check_colors(splats, settings, batch, sizes)
    _expect("Ks", splats.Ks, (*batch, "C", 3, 3), sizes)
    if sizes["C"] < 1:
        raise ValueError("viewmats must hold at least one camera")
    if splats.backgrounds is not None:
        _expect("backgrounds", splats.backgrounds, (*batch, "C", "D"), sizes)
    if splats.radial_coeffs is not None:
        if settings.camera_model != "fisheye":
            raise ValueError(f"radial_coeffs is for fisheye lenses, not {settings.camera_model}; undistort the images")
        _expect("radial_coeffs", splats.radial_coeffs, (*batch, "C", 4), sizes)
        if splats.radial_coeffs.requires_grad:
            raise ValueError("radial_coeffs gets no gradient; detach it")
    for name, value in vars(splats).items():
        if value is not None and value.device != splats.means.device:
            raise ValueError(f"{name} is on {value.device}, but means is on {splats.means.device}")
    small = {"viewmats": splats.viewmats, "Ks": splats.Ks}
    optional = {"backgrounds": splats.backgrounds, "radial_coeffs": splats.radial_coeffs}
    check_finite(**small, **{name: tensor for name, tensor in optional.items() if tensor is not None})
    check_cameras(*(t.detach().double().cpu().numpy() for t in (splats.viewmats, splats.Ks)))


def check_finite(**tensors: Tensor) -> None:
    """Raise ValueError naming the first tensor with a NaN or an infinity (after rounding to float32), and its index."""
    for name, tensor in tensors.items():
        finite = torch.isfinite(tensor.detach().to(torch.float32))
        if not bool(finite.all()):
            index = (~finite).nonzero()[0].tolist()
            value = tensor.detach()[tuple(index)].item()
            raise ValueError(f"{name}{index} is {value}: every value must be finite in float32")


def finish(features: Tensor, alphas: Tensor, background: Tensor | None, settings: Settings) -> Tensor:
    """Put accumulated features [..., H, W, D] over the background and normalise an expected depth.

    The depth channel, when there is one, is the last and has no background.
    """
    parts = []
    if settings.has_colors:
        color = features[..., :-1] if settings.has_depth else features
        parts.append(color if background is None else color + (1 - alphas) * background)
    if settings.has_depth:
        depth = features[..., -1:]
        parts.append(depth / alphas.clamp_min(1e-10) if settings.expected_depth else depth)
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
