"""Catalogue lines 1 to 10, 25 and 26: shapes, cameras and distances at which projection is known to break."""

from __future__ import annotations

import math

import pytest
import torch

from drjit_splat import rasterization, reference
from tests.drjit_splat.common import assert_close, compare, one_splat, random_scene, render_with_gradients

from .conftest import Worst
from .scenes import noted


@pytest.mark.parametrize("length", [0.0, 1e-10])
def test_01_quaternion_without_direction_is_the_identity(length: float) -> None:
    scene = one_splat(scales=[[0.5, 0.2, 0.1]])
    expected = rasterization(**scene, width=16, height=16)[0]
    scene["quats"] = torch.tensor([[0.3, -0.5, 0.2, 0.7]]) * length
    image, gradients, _ = render_with_gradients(scene, 16, 16)
    assert torch.equal(image, expected)
    assert gradients["quats"].abs().max() == 0


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_02_length_of_a_quaternion_does_not_matter(worst: Worst, factor: float) -> None:
    scene = random_scene(count=50)
    image = rasterization(**scene, width=64, height=64)[0]
    scene["quats"] *= factor
    assert float((rasterization(**scene, width=64, height=64)[0] - image).abs().max()) < 1e-5
    assert_close(noted(worst, compare(scene, 64, 64)))


def test_03_log_scales_get_the_chain_factor() -> None:
    scene = random_scene(count=50)
    _, direct, _ = render_with_gradients(scene, 64, 64)
    logs = scene["scales"].log().requires_grad_()
    image, alpha, _ = rasterization(**(scene | {"scales": logs.exp()}), width=64, height=64)
    (image.sum() + alpha.sum()).backward()
    assert logs.grad is not None
    assert torch.allclose(logs.grad, direct["scales"] * scene["scales"], rtol=1e-3, atol=1e-4)


def test_04_flat_splats_have_finite_gradients(worst: Worst) -> None:
    scene = random_scene(count=50)
    scene["scales"][:, 1] = 1e-8
    assert_close(noted(worst, compare(scene, 64, 64)))


def test_05_needles_match_the_oracle(worst: Worst) -> None:
    scene = one_splat(scales=[[30.0, 3e-3, 3e-3]], quats=[[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]])
    c = noted(worst, compare(scene, 16, 16))
    assert_close(c, gradient=1e-3)


def test_06_edge_on_disc_without_low_pass_is_culled_on_both_sides() -> None:
    scene = one_splat(scales=[[0.1, 0.1, 1e-9]], quats=[[math.sqrt(0.5), math.sqrt(0.5), 0, 0]])
    _, gradients, meta = render_with_gradients(scene, 16, 16, eps2d=0.0)
    assert meta["n_culled"][0]["degenerate"] == 1
    assert all(float(g.abs().max()) == 0 for g in gradients.values())
    assert not reference.rasterization(**scene, width=16, height=16, eps2d=0.0)[2]["visible"].any()


@pytest.mark.parametrize("depth", [0.01, 0.0, -1.0, 1e-30])
def test_08_at_or_behind_the_near_plane_is_culled(depth: float) -> None:
    scene = one_splat(means=[[0.0, 0.0, depth]])
    image, gradients, meta = render_with_gradients(scene, 16, 16)
    assert meta["n_culled"][0]["depth"] == 1
    assert image.abs().max() == 0
    assert all(float(g.abs().max()) == 0 for g in gradients.values())


def test_08_one_step_beyond_the_near_plane_is_drawn() -> None:
    near = torch.nextafter(torch.tensor(0.01), torch.tensor(1.0))
    scene = one_splat(means=[[0.0, 0.0, float(near)]], scales=[[1e-3] * 3])
    assert rasterization(**scene, width=16, height=16)[2]["n_visible"] == [1]


def test_08_far_plane_and_radius_clip_cull() -> None:
    scene = one_splat()
    assert rasterization(**scene, width=16, height=16, far_plane=1.9)[2]["n_culled"][0]["depth"] == 1
    radius = int(rasterization(**scene, width=16, height=16)[2]["radii"].max())
    assert rasterization(**scene, width=16, height=16, radius_clip=radius - 1)[2]["n_visible"] == [1]
    assert rasterization(**scene, width=16, height=16, radius_clip=radius)[2]["n_culled"][0]["radius_clip"] == 1


def test_09_splats_beyond_the_frustum_match_with_the_clamped_jacobian(worst: Worst) -> None:
    scene = random_scene(count=60)
    scene["means"][:, :2] *= 4
    scene["scales"] *= 12
    c = noted(worst, compare(scene, 64, 64))
    slope = c.expected["means2d"][0, :, 0]
    assert int(((slope < -0.3 * 32) | (slope > 64 + 0.3 * 32)).sum()) > 10
    assert_close(c)


@pytest.mark.parametrize("zoom", [0.1, 10.0])
def test_25_zoom_keeps_gradients_finite(worst: Worst, zoom: float) -> None:
    scene = random_scene(count=100)
    scene["Ks"][:, :2, :2] *= zoom
    for mode in ("classic", "antialiased"):
        c = noted(worst, compare(scene, 64, 64, rasterize_mode=mode))
        assert c.image < 5e-5
        assert c.gradients["means"] < 1e-4


def test_26_coordinates_of_an_8k_image() -> None:
    scene = random_scene(count=100, width=8192, height=8)
    scene["scales"] *= 0.05
    scene["Ks"] = torch.tensor([[[4000.0, 0, 8000], [0, 4000, 4], [0, 0, 1]]])
    scene["viewmats"][0] = torch.eye(4)
    scene["means"] = scene["means"] * torch.tensor([0.1, 0.002, 0.2]) + torch.tensor([0.0, 0.0, 2.0])
    _, alpha, meta = rasterization(**scene, width=8192, height=8)
    assert meta["n_visible"][0] > 50
    wanted = reference.rasterization(**scene, width=8192, height=8)[1]
    assert float((alpha - wanted).abs().max()) < 1e-2
    assert float((alpha - wanted).abs().mean()) < 1e-5
