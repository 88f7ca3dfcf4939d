"""Catalogue lines 11 to 17: opacities, stacks and exponents at which blending is known to break."""

from __future__ import annotations

import math

import pytest
import torch

from drjit_splat import constants, rasterization, reference
from tests.drjit_splat.common import assert_close, compare, one_splat, random_scene, render_with_gradients

from .conftest import Worst
from .scenes import noted


def stacked(opacities: list[float], scale: float = 0.5) -> dict[str, torch.Tensor]:
    """Splats behind each other on the optical axis, not round: the rotation of a ball has no gradient to compare."""
    n = len(opacities)
    return one_splat(
        means=[[0.0, 0.0, 2.0 + 0.1 * i] for i in range(n)],
        quats=[[1.0, 0.0, 0.0, 0.0]] * n,
        scales=[[scale, 0.8 * scale, 0.6 * scale]] * n,
        opacities=opacities,
        colors=[[1.0 - i / n, i / n, 0.5] for i in range(n)],
    )


@pytest.mark.parametrize("opacity", [0.0, 0.002, 1 / 255 - 1e-9, 1 / 255, 1 / 255 + 1e-9, 1.0])
def test_11_opacities_at_their_limits(opacity: float) -> None:
    image, gradients, _ = render_with_gradients(one_splat(opacities=[opacity]), 16, 16)
    assert 0 <= float(image.max()) <= constants.ALPHA_MAX
    assert all(torch.isfinite(g).all() for g in gradients.values())


def test_12_clamped_opacity_has_no_gradient() -> None:
    scene = one_splat(opacities=[1.0], scales=[[1e3] * 3])
    image, gradients, _ = render_with_gradients(scene, 16, 16)
    assert float(image[..., 0].min()) == pytest.approx(constants.ALPHA_MAX)
    assert gradients["opacities"].abs().max() == 0
    assert gradients["colors"].abs().max() > 1


def test_13_thirty_thousand_splats_behind_each_other() -> None:
    g = torch.Generator().manual_seed(1)
    n = 30_000
    scene = one_splat(
        means=torch.cat([0.02 * torch.randn(n, 2, generator=g), 1 + torch.rand(n, 1, generator=g)], -1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.3),
        opacities=torch.full((n,), 0.5),
        colors=torch.rand(n, 3, generator=g),
        Ks=[[[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]],
    )
    leaves = {k: v.requires_grad_() for k, v in scene.items()}
    _, alpha, meta = rasterization(**leaves, width=32, height=32)
    alpha.sum().backward()
    assert 0.99 < float(alpha.detach()[0, 16, 16, 0]) <= 1 - 0.999 * constants.T_MIN
    assert meta["n_culled"][0]["occluded_pairs"] > 0.9 * meta["n_pairs"][0]
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves.values() if leaf.grad is not None)


def test_14_opaque_stack_stops_at_the_same_splat_in_both_passes(worst: Worst) -> None:
    c = noted(worst, compare(stacked([0.95] * 8), 16, 16))
    assert_close(c)
    _, gradients, _ = render_with_gradients(stacked([0.95] * 8, scale=1e3), 16, 16)
    assert (gradients["colors"][:3].abs().sum(-1) > 0).all()
    assert gradients["colors"][3:].abs().max() == 0


def test_15_faint_splats_after_the_last_contributor(worst: Worst) -> None:
    assert_close(noted(worst, compare(stacked([0.5, 0.9, 0.002, 0.001, 0.003]), 16, 16)))


def test_16_background_gradient_counts_every_pixel_once() -> None:
    scene = one_splat(scales=[[0.05] * 3], backgrounds=[[0.2, 0.4, 0.6]])
    _, gradients, _ = render_with_gradients(scene, 16, 16)
    left = 1 - rasterization(**scene, width=16, height=16)[1]
    assert gradients["backgrounds"][0].tolist() == pytest.approx([float(left.sum())] * 3, rel=1e-5)
    assert float(left[0, 0, 0]) == 1


def test_17_far_along_a_needle_the_exponent_keeps_its_sign() -> None:
    scene = one_splat(
        means=[[70.0, 70.0, 2.0]],
        scales=[[300.0, 1e-2, 1e-2]],
        quats=[[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]],
    )
    _, alpha, _ = rasterization(**scene, width=16, height=16)
    wanted = reference.rasterization(**scene, width=16, height=16)[1]
    assert float(wanted.max()) > 0.7
    assert float(alpha.max()) <= 0.8
    assert float((alpha - wanted).abs().max()) < 2e-3


def test_17_huge_splats_and_far_means_stay_finite() -> None:
    scene = random_scene(count=20)
    scene["scales"][0], scene["scales"][1], scene["scales"][2] = 1e20, 1e15, 1e5
    scene["means"][3], scene["quats"][4] = 1e30, 1e15
    image, gradients, meta = render_with_gradients(scene, 64, 64)
    assert torch.isfinite(image).all()
    assert all(torch.isfinite(g).all() for g in gradients.values())
    assert meta["n_culled"][0]["degenerate"] >= 2
