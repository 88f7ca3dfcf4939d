"""Random scenes and the comparison of the kernels with the float64 oracle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from drjit_splat import rasterization, reference

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")


def random_scene(
    count: int = 500, width: int = 64, height: int = 64, channels: int = 3, cameras: int = 1, seed: int = 0
) -> dict[str, Tensor]:
    """Float32 arguments: splats of mixed sizes before off-centre cameras, some partly out of the image."""
    g = torch.Generator().manual_seed(seed)
    views, Ks = [], []
    for i in range(cameras):
        angle = 0.3 * i + 0.1
        view = torch.eye(4)
        view[0, 0] = view[2, 2] = math.cos(angle)
        view[0, 2], view[2, 0] = math.sin(angle), -math.sin(angle)
        view[:3, 3] = torch.tensor([0.05, -0.03, 2.0])
        views.append(view)
        Ks.append(torch.tensor([[1.1 * width, 0, 0.45 * width], [0, 1.05 * width, 0.57 * height], [0, 0, 1]]))
    return {
        "means": (torch.rand(count, 3, generator=g) - 0.5) * torch.tensor([1.6, 1.6, 1.0]),
        "quats": torch.randn(count, 4, generator=g),
        "scales": torch.exp(0.6 * torch.randn(count, 3, generator=g) - 3.2),
        "opacities": 0.04 + 0.95 * torch.rand(count, generator=g),
        "colors": torch.rand(count, channels, generator=g),
        "viewmats": torch.stack(views),
        "Ks": torch.stack(Ks),
        "backgrounds": torch.rand(cameras, channels, generator=g),
    }


@dataclass(frozen=True)
class Comparison:
    """Errors of the kernels against the oracle."""

    image: float  # largest absolute error over trusted pixels
    alpha: float
    gradients: dict[str, float]  # relative L2 error by argument
    trusted: float  # share of the pixels whose decisions lie clear of every threshold
    meta: dict[str, Any]
    expected: dict[str, Any]  # meta of the oracle


def compare(scene: dict[str, Tensor], width: int, height: int, margin: float = 1e-4, **options: Any) -> Comparison:
    """Render and differentiate a weighted sum of image and coverage on both sides.

    The oracle takes the depth order from the kernels' float32 depths, and pixels within `margin` of a threshold get no
    weight, so that what is left must agree to rounding.
    """
    single = {k: v.clone().requires_grad_() for k, v in scene.items()}
    double = {k: v.double().requires_grad_() for k, v in scene.items()}
    image, alpha, meta = rasterization(**single, width=width, height=height, packed=False, **options)
    order = torch.argsort(meta["depths"], dim=-1, stable=True)
    wanted, wanted_alpha, expected = reference.rasterization(
        **double, width=width, height=height, order=order, **options
    )
    trusted = (expected["margin"] > margin)[..., None]
    g = torch.Generator().manual_seed(99)
    weight = torch.randn(wanted.shape, generator=g, dtype=torch.float64) * trusted
    weight_alpha = torch.randn(wanted_alpha.shape, generator=g, dtype=torch.float64) * trusted
    ((image * weight.float()).sum() + (alpha * weight_alpha.float()).sum()).backward()
    ((wanted * weight).sum() + (wanted_alpha * weight_alpha).sum()).backward()
    errors = {}
    for name in scene:
        got, want = single[name].grad, double[name].grad
        assert (got is None) == (want is None), name
        if got is not None and want is not None:
            assert torch.isfinite(got).all(), name
            errors[name] = float((got - want).norm() / want.norm().clamp_min(1e-12))
    return Comparison(
        float(((image - wanted).detach().abs() * trusted).max()),
        float(((alpha - wanted_alpha).detach().abs() * trusted).max()),
        errors,
        float(trusted.double().mean()),
        meta,
        expected,
    )


def assert_close(c: Comparison, image: float = 2e-5, gradient: float = 5e-5) -> None:
    """Bounds on every error; most pixels must have taken part."""
    assert c.trusted > 0.9
    assert c.image <= image
    assert c.alpha <= image
    assert {name: e for name, e in c.gradients.items() if e > gradient} == {}
    assert torch.equal(c.meta["visible"], c.expected["visible"])


def one_splat(**changes: Any) -> dict[str, Tensor]:
    """A single round splat in the middle of a 16 x 16 image, 5 pixels wide; `changes` replace arguments."""
    scene: dict[str, Any] = {
        "means": [[0.0, 0.0, 2.0]],
        "quats": [[1.0, 0.0, 0.0, 0.0]],
        "scales": [[0.5, 0.5, 0.5]],
        "opacities": [0.8],
        "colors": [[1.0, 0.5, 0.25]],
        "viewmats": torch.eye(4)[None],
        "Ks": [[[20.0, 0.0, 8.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]]],
    }
    return {k: torch.as_tensor(v, dtype=torch.float32).clone() for k, v in (scene | changes).items()}


def render_with_gradients(scene: dict[str, Tensor], width: int, height: int, **options: Any) -> tuple[Tensor, Any, Any]:
    """Image, gradients of the sum of image and coverage by argument, and meta."""
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    image, alpha, meta = rasterization(**leaves, width=width, height=height, packed=False, **options)
    (image.sum() + alpha.sum()).backward()
    return image.detach(), {k: v.grad for k, v in leaves.items()}, meta
