"""Images and gradients of the kernels against the float64 oracle."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch

from drjit_splat import rasterization, reference

from .common import NAMES, assert_close, compare, random_scene, render_with_gradients


@pytest.mark.parametrize("seed", [0, 1])
def test_image_and_every_gradient(seed: int) -> None:
    c = compare(random_scene(seed=seed), 64, 64)
    assert set(c.gradients) == set(NAMES)
    assert_close(c)
    assert torch.equal(c.meta["radii"], c.expected["radii"])
    assert torch.allclose(c.meta["means2d"].double(), c.expected["means2d"], atol=1e-4)
    assert torch.allclose(c.meta["depths"].double(), c.expected["depths"], atol=1e-6)


def test_large_splats_and_opaque_pixels() -> None:
    scene = random_scene()
    scene["scales"] *= 4
    c = compare(scene, 64, 64)
    assert_close(c)
    assert c.meta["n_culled"][0]["occluded_pairs"] > 1000


@pytest.mark.parametrize(("width", "height"), [(61, 47), (1, 1), (3, 200)])
def test_sizes_that_are_no_multiple_of_the_tile(width: int, height: int) -> None:
    assert_close(compare(random_scene(width=width, height=height), width, height), gradient=1e-3)


def test_small_splats_on_a_larger_image() -> None:
    # Lists of odd length end inside a turn of the loop; the idle half must not show the first splat's tail.
    scene = random_scene(count=400, width=160, height=120, seed=5)
    scene["scales"] *= 0.15
    scene["means"][0] = torch.tensor([0.8, 0.8, 0.0])
    scene["scales"][0], scene["opacities"][0] = 1e-3, 0.99
    assert_close(compare(scene, 160, 120))


def test_two_cameras() -> None:
    c = compare(random_scene(cameras=2), 64, 64)
    assert_close(c)
    assert len(c.meta["n_visible"]) == 2


@pytest.mark.parametrize("channels", [1, 4, 9, 32])
def test_channel_counts(channels: int) -> None:
    c = compare(random_scene(count=200, width=32, height=32, channels=channels), 32, 32)
    assert_close(c)


@pytest.mark.parametrize("mode", ["D", "ED", "RGB+D", "RGB+ED"])
def test_depth_modes(mode: str) -> None:
    assert_close(compare(random_scene(), 64, 64, render_mode=mode), image=5e-5)


def test_depth_beside_eight_channels() -> None:
    scene = random_scene(count=200, width=32, height=32, channels=8)
    assert_close(compare(scene, 32, 32, render_mode="RGB+D"))


def test_antialiased() -> None:
    scene = random_scene()
    scene["scales"] *= 0.4
    assert_close(compare(scene, 64, 64, rasterize_mode="antialiased"))
    classic = rasterization(**scene, width=64, height=64)[1]
    assert rasterization(**scene, width=64, height=64, rasterize_mode="antialiased")[1].sum() < classic.sum()


@pytest.mark.parametrize("eps2d", [0.0, 0.1, 1.0])
def test_other_low_passes(eps2d: float) -> None:
    assert_close(compare(random_scene(), 64, 64, eps2d=eps2d))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(degree: int) -> None:
    scene = random_scene(count=100, width=32, height=32)
    g = torch.Generator().manual_seed(7)
    scene["colors"] = 0.2 * torch.randn(100, 16, 3, generator=g)
    c = compare(scene, 32, 32, sh_degree=degree)
    assert_close(c)


def test_wide_depth_range_keeps_the_order() -> None:
    scene = random_scene(count=1200)
    g = torch.Generator().manual_seed(2)
    depth = 0.5 * 64 ** torch.rand(1200, generator=g)
    # Half of the splats come in pairs one rounding step apart, which a shortened sort key would merge.
    depth[1::2] = torch.nextafter(depth[::2], torch.tensor(100.0))
    scene["viewmats"] = torch.eye(4)[None]
    scene["means"] = torch.cat([scene["means"][:, :2] * depth[:, None] * 0.5, depth[:, None]], -1)
    scene["scales"] = scene["scales"] * depth[:, None]
    order = torch.randperm(1200, generator=g)
    shuffled = {k: v[order] if len(v) == 1200 else v for k, v in scene.items()}
    assert depth.max() / depth.min() > 30
    image = rasterization(**scene, width=64, height=64)[0]
    assert torch.equal(image, rasterization(**shuffled, width=64, height=64)[0])
    wanted, _, meta = reference.rasterization(**scene, width=64, height=64)
    trusted = (meta["margin"] > 1e-4)[..., None]
    assert float(((image - wanted).abs() * trusted).max()) < 2e-5


def test_runs_are_bit_equal_and_equal_depths_are_ordered_by_index() -> None:
    scene = random_scene()
    scene["means"][:, 2] = 0
    scene["viewmats"] = torch.eye(4)[None]
    scene["viewmats"][0, 2, 3] = 2
    first = rasterization(**scene, width=64, height=64)
    second = rasterization(**scene, width=64, height=64)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert len(first[2]["depths"].unique()) == 1
    assert compare(scene, 64, 64).image < 2e-5


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_results_come_back_in_the_callers_dtype(dtype: torch.dtype) -> None:
    scene = {k: v.to(dtype) for k, v in random_scene(count=50).items()}
    image, gradients, _ = render_with_gradients(scene, 64, 64)
    assert image.dtype == dtype
    assert all(g.dtype == dtype for g in gradients.values())
    single = rasterization(**{k: v.float() for k, v in scene.items()}, width=64, height=64)[0]
    assert torch.equal(image, single.to(dtype))


def test_strided_inputs_and_gradients() -> None:
    scene = random_scene(count=100)
    strided = {k: torch.stack([v, v], -1)[..., 0] for k, v in scene.items()}
    assert not strided["means"].is_contiguous()
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    strided_leaves = {k: v.detach().requires_grad_() for k, v in strided.items()}
    weight = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(3))
    for inputs, g in ((leaves, weight), (strided_leaves, weight.transpose(1, 2).contiguous().transpose(1, 2))):
        rasterization(**inputs, width=64, height=64)[0].backward(g)
    for name in scene:
        a, b = leaves[name].grad, strided_leaves[name].grad
        assert a is not None and b is not None
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(a.abs().max())), name


@pytest.mark.parametrize("name", NAMES)
def test_one_input_alone_may_need_a_gradient(name: str) -> None:
    scene = random_scene(count=100)
    weight = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(3))

    def gradient(active: tuple[str, ...]) -> torch.Tensor:
        leaves = {k: v.clone().requires_grad_(k in active) for k, v in scene.items()}
        rasterization(**leaves, width=64, height=64)[0].backward(weight)
        assert all((leaf.grad is not None) == (k in active) for k, leaf in leaves.items())
        found = leaves[name].grad
        assert found is not None
        return found

    together, alone = gradient(NAMES), gradient((name,))
    assert torch.allclose(alone, together, rtol=1e-4, atol=1e-5 * float(together.abs().max()))


def test_backward_twice_through_one_graph() -> None:
    scene = {k: v.requires_grad_() for k, v in random_scene(count=100).items()}
    image = rasterization(**scene, width=64, height=64)[0]
    leaves = list(scene.values())
    red = torch.autograd.grad(image[..., 0].sum(), leaves, retain_graph=True)
    green = torch.autograd.grad(image[..., 1].sum(), leaves, retain_graph=True)
    both = torch.autograd.grad(image[..., :2].sum(), leaves)
    for r, g, b in zip(red, green, both, strict=True):
        assert float((r + g - b).norm()) <= 1e-5 * float(b.norm())
        assert float((r - g).norm()) > 1e-3 * float(r.norm())


def test_editing_an_input_before_backward_is_noticed() -> None:
    scene: dict[str, Any] = random_scene(count=20)
    colors = scene["colors"].requires_grad_() * 1
    image = rasterization(**(scene | {"colors": colors}), width=16, height=16)[0]
    with torch.no_grad():
        colors.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_threads_may_render_at_once() -> None:
    scenes = [random_scene(count=count, seed=count) for count in (200, 300)]

    def step(scene: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        means = scene["means"].clone().requires_grad_()
        image = rasterization(**(scene | {"means": means}), width=64, height=64)[0]
        return image.detach(), torch.autograd.grad(image.square().sum(), means)[0]

    expected = [step(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for index, (image, gradient) in enumerate(pool.map(step, scenes * 20)):
            assert torch.equal(image, expected[index % 2][0])
            torch.testing.assert_close(gradient, expected[index % 2][1], rtol=1e-4, atol=1e-5)
