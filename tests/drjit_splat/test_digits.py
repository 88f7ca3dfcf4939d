"""Gradients keep their digits where terms grow with a splat and all but cancel, or next to nothing is covered."""

from __future__ import annotations

import pytest
import torch

from drjit_splat import rasterization, reference

from .common import compare, one_splat

TURNED = [[0.6, 0.3, -0.5, 0.4]]


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize(
    "scales", [*([length, 0.02, 0.01] for length in (1e1, 1e3, 1e5, 1e7)), [10, 5, 0.01], [1e4, 5e3, 0.01]]
)
def test_needles_and_discs(scales: list[float], mode: str) -> None:
    c = compare(one_splat(scales=[scales], quats=TURNED), 16, 16, rasterize_mode=mode)
    assert c.image < 1e-5
    assert {name: e for name, e in c.gradients.items() if e > 1e-4} == {}


def test_a_needle_whose_variance_squared_leaves_float32() -> None:
    scene = one_splat(scales=[[3e7, 0.01, 0.01]], quats=[[0.7, 0.1, -0.1, 0.7]])
    scene["Ks"][:, :2, :2] *= 20
    c = compare(scene, 16, 16)
    assert {name: e for name, e in c.gradients.items() if e > 1e-4} == {}


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4])
def test_splats_far_thinner_than_a_pixel_without_low_pass(width: float) -> None:
    off = 0.05 + 0.5 * width  # pixel centres lie half a deviation beside the axis
    c = compare(one_splat(scales=[[1.0, width, width]], means=[[off, off, 2.0]]), 16, 16, eps2d=0.0)
    assert c.image < 1e-5 and {name: e for name, e in c.gradients.items() if e > 1e-4} == {}


@pytest.mark.parametrize("opacity", [0.9, 0.02, 0.0045])
def test_expected_depth_where_little_is_covered(opacity: float) -> None:
    scene = one_splat(opacities=[opacity])
    image, alpha, _ = rasterization(**scene, width=16, height=16, render_mode="ED")
    seen = alpha[..., 0] > 0
    assert float((image[..., 0][seen] - 2.0).abs().max()) < 1e-6
    wanted = reference.rasterization(**scene, width=16, height=16, render_mode="ED")[1]
    assert float((alpha.double() - wanted)[seen].abs().max()) < 1e-6 * opacity
    scene = one_splat(
        means=[[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]],
        quats=TURNED * 2,
        scales=[[0.5, 0.4, 0.3]] * 2,
        opacities=[opacity, opacity],
        colors=torch.rand(2, 3).tolist(),
    )
    c = compare(scene, 16, 16, render_mode="ED")
    assert {name: e for name, e in c.gradients.items() if e > 5e-5} == {}
