"""Inputs at which splatting code is known to break."""

from __future__ import annotations

import math
import re

import pytest
import torch

from drjit_splat import constants, rasterization, reference

from .common import assert_close, compare, one_splat, random_scene, render_with_gradients


def stacked(opacities: list[float], scale: float = 0.5) -> dict[str, torch.Tensor]:
    """Splats behind each other on the optical axis."""
    n = len(opacities)
    return one_splat(
        means=[[0.0, 0.0, 2.0 + 0.1 * i] for i in range(n)],
        quats=[[1.0, 0.0, 0.0, 0.0]] * n,
        scales=[[scale] * 3] * n,
        opacities=opacities,
        colors=[[1.0 - i / n, i / n, 0.5] for i in range(n)],
    )


@pytest.mark.parametrize("length", [0.0, 1e-10])
def test_quaternion_without_direction_is_the_identity(length: float) -> None:
    scene = one_splat(scales=[[0.5, 0.2, 0.1]])
    expected = rasterization(**scene, width=16, height=16)[0]
    scene["quats"] = torch.tensor([[0.3, -0.5, 0.2, 0.7]]) * length
    image, gradients, _ = render_with_gradients(scene, 16, 16)
    assert torch.equal(image, expected)
    assert gradients["quats"].abs().max() == 0


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_length_of_a_quaternion_does_not_matter(factor: float) -> None:
    scene = random_scene(count=50)
    image = rasterization(**scene, width=64, height=64)[0]
    scene["quats"] *= factor
    assert float((rasterization(**scene, width=64, height=64)[0] - image).abs().max()) < 1e-5
    assert_close(compare(scene, 64, 64))


def test_log_scales_get_the_chain_factor() -> None:
    scene = random_scene(count=50)
    _, direct, _ = render_with_gradients(scene, 64, 64)
    logs = scene["scales"].log().requires_grad_()
    image, alpha, _ = rasterization(**(scene | {"scales": logs.exp()}), width=64, height=64)
    (image.sum() + alpha.sum()).backward()
    assert logs.grad is not None
    assert torch.allclose(logs.grad, direct["scales"] * scene["scales"], rtol=1e-3, atol=1e-4)


def test_flat_splats_have_finite_gradients() -> None:
    scene = random_scene(count=50)
    scene["scales"][:, 1] = 1e-8
    assert_close(compare(scene, 64, 64))


def test_needles_match_the_oracle() -> None:
    scene = one_splat(scales=[[30.0, 3e-3, 3e-3]], quats=[[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]])
    c = compare(scene, 16, 16)
    assert_close(c, gradient=1e-3)


def test_far_along_a_needle_the_exponent_keeps_its_sign() -> None:
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


def test_edge_on_disc_without_low_pass_is_culled_on_both_sides() -> None:
    scene = one_splat(scales=[[0.1, 0.1, 1e-9]], quats=[[math.sqrt(0.5), math.sqrt(0.5), 0, 0]])
    _, gradients, meta = render_with_gradients(scene, 16, 16, eps2d=0.0)
    assert meta["n_culled"][0]["degenerate"] == 1
    assert all(float(g.abs().max()) == 0 for g in gradients.values())
    assert not reference.rasterization(**scene, width=16, height=16, eps2d=0.0)[2]["visible"].any()


@pytest.mark.parametrize("depth", [0.01, 0.0, -1.0, 1e-30])
def test_at_or_behind_the_near_plane_is_culled(depth: float) -> None:
    scene = one_splat(means=[[0.0, 0.0, depth]])
    image, gradients, meta = render_with_gradients(scene, 16, 16)
    assert meta["n_culled"][0]["depth"] == 1
    assert image.abs().max() == 0
    assert all(float(g.abs().max()) == 0 for g in gradients.values())


def test_one_step_beyond_the_near_plane_is_drawn() -> None:
    near = torch.nextafter(torch.tensor(0.01), torch.tensor(1.0))
    scene = one_splat(means=[[0.0, 0.0, float(near)]], scales=[[1e-3] * 3])
    assert rasterization(**scene, width=16, height=16)[2]["n_visible"] == [1]


def test_far_plane_and_radius_clip_cull() -> None:
    scene = one_splat()
    assert rasterization(**scene, width=16, height=16, far_plane=1.9)[2]["n_culled"][0]["depth"] == 1
    radius = int(rasterization(**scene, width=16, height=16)[2]["radii"].max())
    assert rasterization(**scene, width=16, height=16, radius_clip=radius - 1)[2]["n_visible"] == [1]
    assert rasterization(**scene, width=16, height=16, radius_clip=radius)[2]["n_culled"][0]["radius_clip"] == 1


def test_splats_beyond_the_frustum_match_with_the_clamped_jacobian() -> None:
    scene = random_scene(count=60)
    scene["means"][:, :2] *= 4
    scene["scales"] *= 12
    c = compare(scene, 64, 64)
    slope = c.expected["means2d"][0, :, 0]
    assert int(((slope < -0.3 * 32) | (slope > 64 + 0.3 * 32)).sum()) > 10
    assert_close(c)


@pytest.mark.parametrize("opacity", [0.0, 0.002, 1 / 255 - 1e-9, 1 / 255, 1 / 255 + 1e-9, 1.0])
def test_opacities_at_their_limits(opacity: float) -> None:
    image, gradients, _ = render_with_gradients(one_splat(opacities=[opacity]), 16, 16)
    assert 0 <= float(image.max()) <= constants.ALPHA_MAX
    assert all(torch.isfinite(g).all() for g in gradients.values())


def test_clamped_opacity_has_no_gradient() -> None:
    scene = one_splat(opacities=[1.0], scales=[[1e3] * 3])
    image, gradients, _ = render_with_gradients(scene, 16, 16)
    assert float(image[..., 0].min()) == pytest.approx(constants.ALPHA_MAX)
    assert gradients["opacities"].abs().max() == 0
    assert gradients["colors"].abs().max() > 1


def test_thirty_thousand_splats_behind_each_other() -> None:
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


def test_opaque_stack_stops_at_the_same_splat_in_both_passes() -> None:
    c = compare(stacked([0.95] * 8), 16, 16)
    assert_close(c)
    _, gradients, _ = render_with_gradients(stacked([0.95] * 8, scale=1e3), 16, 16)
    assert (gradients["colors"][:3].abs().sum(-1) > 0).all()
    assert gradients["colors"][3:].abs().max() == 0


def test_faint_splats_after_the_last_contributor() -> None:
    assert_close(compare(stacked([0.5, 0.9, 0.002, 0.001, 0.003]), 16, 16))


def test_background_gradient_counts_every_pixel_once() -> None:
    scene = one_splat(scales=[[0.05] * 3], backgrounds=[[0.2, 0.4, 0.6]])
    _, gradients, _ = render_with_gradients(scene, 16, 16)
    left = 1 - rasterization(**scene, width=16, height=16)[1]
    assert gradients["backgrounds"][0].tolist() == pytest.approx([float(left.sum())] * 3, rel=1e-5)
    assert float(left[0, 0, 0]) == 1


def test_huge_splats_and_far_means_stay_finite() -> None:
    scene = random_scene(count=20)
    scene["scales"][0], scene["scales"][1], scene["scales"][2] = 1e20, 1e15, 1e5
    scene["means"][3], scene["quats"][4] = 1e30, 1e15
    image, gradients, meta = render_with_gradients(scene, 64, 64)
    assert torch.isfinite(image).all()
    assert all(torch.isfinite(g).all() for g in gradients.values())
    assert meta["n_culled"][0]["degenerate"] >= 2


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_value_that_is_not_finite_is_named(name: str, value: float) -> None:
    scene = random_scene(count=20)
    scene[name].view(-1)[2] = value
    index = [int(i) for i in torch.unravel_index(torch.tensor(2), scene[name].shape)]
    strided = scene | {name: torch.stack([scene[name], scene[name]], -1)[..., 0]}
    for case in (scene, strided):
        with pytest.raises(ValueError, match=re.escape(f"{name}{index} is {value}")):
            rasterization(**case, width=16, height=16)


def test_no_splats_none_visible_and_one_visible() -> None:
    scene = random_scene(count=5, width=9, height=7)
    background = scene["backgrounds"].view(1, 1, 1, 3).expand(1, 7, 9, 3)
    empty = {k: v[:0] if len(v) == 5 else v for k, v in scene.items()}
    hidden = scene | {"means": scene["means"] - 10}
    behind_one = scene | {"means": torch.cat([scene["means"][:1], scene["means"][1:] - 10])}
    for case, visible in ((empty, 0), (hidden, 0), (behind_one, 1)):
        image, gradients, meta = render_with_gradients(case, 9, 7)
        assert image.shape == (1, 7, 9, 3)
        assert meta["n_visible"] == [visible]
        if not visible:
            assert torch.equal(image, background)
            assert all(not g.any() for name, g in gradients.items() if name != "backgrounds")
        assert gradients["means"].shape == case["means"].shape
        assert meta["means2d"].shape == (1, len(case["means"]), 2)


def test_too_many_pairs_are_refused_before_allocation() -> None:
    n = 20_000
    scene = one_splat(
        means=torch.tensor([[0.0, 0, 2]]).repeat(n, 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 1e3),
        opacities=torch.full((n,), 0.5),
        colors=torch.rand(n, 1),
    )
    with pytest.raises(MemoryError, match="pairs"):
        rasterization(**scene, width=2048, height=2048)


def test_every_counted_pair_reaches_a_tile() -> None:
    scene = random_scene(count=5000, width=300, height=200)
    scene["opacities"] *= 0.02 / scene["opacities"].max()
    scene["opacities"] += 0.003
    scene["scales"] *= 0.5
    meta = rasterization(**scene, width=300, height=200)[2]
    assert meta["n_pairs"][0] > 20_000
    assert meta["n_culled"][0]["occluded_pairs"] == 0


@pytest.mark.parametrize("zoom", [0.1, 10.0])
def test_zoom_keeps_gradients_finite(zoom: float) -> None:
    scene = random_scene(count=100)
    scene["Ks"][:, :2, :2] *= zoom
    for mode in ("classic", "antialiased"):
        c = compare(scene, 64, 64, rasterize_mode=mode)
        assert c.image < 5e-5
        assert c.gradients["means"] < 1e-4


def test_coordinates_of_an_8k_image() -> None:
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
