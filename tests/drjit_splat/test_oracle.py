"""The oracle itself: derivatives by finite differences and values worked out by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from drjit_splat import _reference_large, reference

from .common import one_splat, random_scene


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_gradients_match_finite_differences_when_decisions_are_fixed(mode: str) -> None:
    scene = {k: v.double() for k, v in random_scene(count=12, width=6, height=5, seed=3).items()}
    scene["scales"] *= 4
    fixed = reference.rasterization(**scene, width=6, height=5, rasterize_mode=mode)[2]["decisions"]
    free = ("means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats")

    def image(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        arguments = scene | dict(zip(free, values, strict=True))
        out = reference.rasterization(
            **arguments, width=6, height=5, rasterize_mode=mode, render_mode="RGB+D", decisions=fixed
        )
        return out[0], out[1]

    inputs = tuple(scene[name].clone().requires_grad_() for name in free)
    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-6, fast_mode=True)


def test_intrinsics_gradient_matches_finite_differences() -> None:
    scene = {k: v.double() for k, v in random_scene(count=12, width=6, height=5, seed=4).items()}
    scene["scales"] *= 4
    fixed = reference.rasterization(**scene, width=6, height=5)[2]["decisions"]

    def image(values: torch.Tensor) -> torch.Tensor:
        K = torch.zeros(1, 3, 3, dtype=torch.float64)
        K[0, 0, 0], K[0, 1, 1], K[0, 0, 2], K[0, 1, 2], K[0, 2, 2] = *values, torch.tensor(1.0)
        return reference.rasterization(**(scene | {"Ks": K}), width=6, height=5, decisions=fixed)[0]

    K = scene["Ks"][0]
    values = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]).requires_grad_()
    assert torch.autograd.gradcheck(image, (values,), eps=1e-6, atol=1e-6)


def test_one_splat_by_hand() -> None:
    scene = one_splat()
    image, alpha, meta = reference.rasterization(**scene, width=16, height=16)
    variance = (20 * 0.5 / 2) ** 2 + 0.3
    expected = 0.8 * math.exp(-0.5 * (0.5**2 + 0.5**2) / variance)
    assert float(alpha[0, 8, 8, 0]) == pytest.approx(expected, abs=1e-7)
    assert image[0, 8, 8].tolist() == pytest.approx([expected, 0.5 * expected, 0.25 * expected], abs=1e-7)
    assert meta["radii"][0, 0].tolist() == [math.ceil(math.sqrt(2 * math.log(0.8 * 255) * variance))] * 2


def test_blending_stops_before_the_splat_that_makes_a_pixel_opaque() -> None:
    scene = one_splat()
    many = {k: v.repeat(4, *[1] * (v.ndim - 1)) for k, v in scene.items() if k not in ("viewmats", "Ks")}
    many["scales"] = torch.full((4, 3), 1e4)
    many["opacities"] = torch.tensor([0.9, 0.99, 0.95, 0.5])  # after two 1e-3 is left, a third would leave 5e-5
    _, alpha, _ = reference.rasterization(**(scene | many), width=16, height=16)
    assert float(alpha[0, 8, 8, 0]) == pytest.approx(1 - 1e-3, abs=1e-6)


@pytest.mark.parametrize("options", [{}, {"semantics": "inria"}, {"render_mode": "RGB+ED"}])
def test_many_pairs_are_blended_in_parts(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(count=400, width=40, height=24)
    scene["opacities"] = scene["opacities"].clamp_min(0.3)  # so that pixels stop
    image, alpha, meta = reference.rasterization(**scene, width=40, height=24, **options)
    monkeypatch.setattr(reference, "LARGE", 1)
    monkeypatch.setattr(_reference_large, "PIXELS", 100)
    parts, part_alpha, part_meta = reference.rasterization(**scene, width=40, height=24, **options)
    assert float((image - parts).abs().max()) < 1e-12 and float((alpha - part_alpha).abs().max()) < 1e-12
    assert part_meta["decisions"] == [None] and (alpha > 1 - 1e-3).any()
    assert (part_meta["margin"] >= meta["margin"] - 1e-9).all()
    scene["means"].requires_grad_()
    assert reference.rasterization(**scene, width=40, height=24, **options)[0].requires_grad
