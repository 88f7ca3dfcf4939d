"""Checks of the public arguments, shared by the kernels and the oracle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ._settings import Settings
from .constants import MAX_CHANNELS


@dataclass(frozen=True)
class Splats:
    """The tensor arguments of one call."""

    means: Tensor  # [N, 3]
    quats: Tensor | None  # [N, 4], with scales; None with covars
    scales: Tensor | None  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, D] or [N, K, D], or one set a camera: [C, N, D] or [C, N, K, D]
    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    backgrounds: Tensor | None = None  # [C, D]
    covars: Tensor | None = None  # [N, 3, 3]

    def to(self, dtype: torch.dtype) -> Splats:
        """All tensors in `dtype`."""
        converted: dict[str, Any] = {k: None if t is None else t.to(dtype) for k, t in vars(self).items()}
        return Splats(**converted)

    def colors_of(self, camera: int, settings: Settings) -> Tensor:
        """Colours or harmonics that camera `camera` sees."""
        shared = 2 if settings.sh_degree is None else 3
        return self.colors if self.colors.ndim == shared else self.colors[camera]


def _expect(name: str, tensor: Tensor | None, shape: tuple[int | str, ...], sizes: dict[str, int]) -> None:
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


def check_shapes(splats: Splats, settings: Settings) -> None:
    """Raise ValueError naming the first argument whose shape, type or value is not allowed."""
    s = settings
    s.check()
    sizes: dict[str, int] = {}
    _expect("means", splats.means, ("N", 3), sizes)
    if splats.covars is None:
        _expect("quats", splats.quats, ("N", 4), sizes)
        _expect("scales", splats.scales, ("N", 3), sizes)
    else:
        _expect("covars", splats.covars, ("N", 3, 3), sizes)
    _expect("opacities", splats.opacities, ("N",), sizes)
    own: tuple[int | str, ...] = ("N", "D") if s.sh_degree is None else ("N", "K", "D")
    if isinstance(splats.colors, Tensor) and splats.colors.ndim == len(own) + 1:
        own = ("C", *own)
    _expect("colors", splats.colors, own, sizes)
    if s.sh_degree is not None and sizes["K"] < (s.sh_degree + 1) ** 2:
        needed = (s.sh_degree + 1) ** 2
        raise ValueError(f"colors has {sizes['K']} harmonics a channel; sh_degree {s.sh_degree} needs {needed}")
    if not 1 <= sizes["D"] <= MAX_CHANNELS:
        raise ValueError(f"colors must have 1 to {MAX_CHANNELS} channels, not {sizes['D']}")
    _expect("viewmats", splats.viewmats, ("C", 4, 4), sizes)
    _expect("Ks", splats.Ks, ("C", 3, 3), sizes)
    if sizes["C"] < 1:
        raise ValueError("viewmats must hold at least one camera")
    if splats.backgrounds is not None:
        _expect("backgrounds", splats.backgrounds, ("C", "D"), sizes)
    for name, value in vars(splats).items():
        if value is not None and value.device != splats.means.device:
            raise ValueError(f"{name} is on {value.device}, but means is on {splats.means.device}")
    _check_cameras(splats)


def _check_cameras(splats: Splats) -> None:
    check_finite(viewmats=splats.viewmats, Ks=splats.Ks)
    if splats.backgrounds is not None:
        check_finite(backgrounds=splats.backgrounds)
    for camera, K in enumerate(splats.Ks.tolist()):
        if K[0][0] <= 0 or K[1][1] <= 0:
            raise ValueError(f"Ks[{camera}] must have positive focal lengths, not {K[0][0]} and {K[1][1]}")
        if K[0][1] != 0 or K[1][0] != 0 or K[2] != [0, 0, 1]:
            raise ValueError(
                f"Ks[{camera}] must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew ({K[0][1]}) is refused because other"
                " rasterizers ignore it silently"
            )


def check_finite(**tensors: Tensor) -> None:
    """Raise ValueError naming the first tensor with a NaN or an infinity (after rounding to float32), and its index."""
    for name, tensor in tensors.items():
        finite = torch.isfinite(tensor.detach().to(torch.float32))
        if not bool(finite.all()):
            index = (~finite).nonzero()[0].tolist()
            value = tensor.detach()[tuple(index)].item()
            raise ValueError(f"{name}{index} is {value}: every value must be finite in float32")


def finish(features: Tensor, alphas: Tensor, background: Tensor | None, settings: Settings) -> Tensor:
    """Put accumulated features [H, W, D] over the background and normalise an expected depth.

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
