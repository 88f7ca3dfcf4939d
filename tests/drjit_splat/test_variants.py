"""Covariances, the original rasterizer's rules, options, and sets of colours for each camera."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from drjit_splat import Options, rasterization, reference
from drjit_splat._settings import Settings

from .common import assert_close, compare, one_splat, random_scene, render_with_gradients


def covariances(scene: dict[str, torch.Tensor]) -> torch.Tensor:
    root = reference.quats_to_rotations(scene["quats"].double()) * scene["scales"].double()[:, None]
    return (root @ root.mT).float()


def test_covariances_render_the_same_and_have_gradients() -> None:
    scene = random_scene()
    expected = rasterization(**scene, width=64, height=64)[0]
    other = {k: v for k, v in scene.items() if k not in ("quats", "scales")} | {"covars": covariances(scene)}
    image, gradients, _ = render_with_gradients(other, 64, 64, quats=None, scales=None)
    assert float((image - expected).abs().max()) < 2e-4
    assert torch.allclose(gradients["covars"], gradients["covars"].mT)


def test_covariance_gradients_match_the_oracle() -> None:
    scene = random_scene(count=200)
    scene["scales"] = scene["scales"].clamp_min(0.02)
    scene["covars"] = covariances(scene)
    del scene["quats"], scene["scales"]
    assert_close(compare(scene, 64, 64, quats=None, scales=None))


def test_inria_rules_match_the_oracle() -> None:
    scene = random_scene(width=64, height=48)
    scene["opacities"][:30] = 1.0
    assert_close(compare(scene, 64, 48, semantics="inria"))
    ours = rasterization(**scene, width=64, height=48)[0]
    theirs = rasterization(**scene, width=64, height=48, semantics="inria")[0]
    assert 1e-3 < float((ours - theirs).abs().max()) < 0.1


def test_inria_rules_cut_squares_and_near_splats() -> None:
    # Seen through 3 sigma squares on 16-pixel tiles, a splat on the border of two tiles ends before its faint rim.
    scene = one_splat(scales=[[0.9] * 3], opacities=[0.99], Ks=[[[20.0, 0, 60.6], [0, 20, 8], [0, 0, 1]]])
    ours = rasterization(**scene, width=128, height=16)[1][0, 8, :, 0]
    theirs = rasterization(**scene, width=128, height=16, semantics="inria")[1][0, 8, :, 0]
    assert int((ours > 0).sum()) > int((theirs > 0).sum())
    assert float(theirs.max()) <= 0.99
    scene = one_splat(means=[[0.0, 0.0, 0.2]], scales=[[0.01] * 3])
    assert rasterization(**scene, width=16, height=16, semantics="inria")[2]["n_visible"] == [0]
    assert rasterization(**scene, width=16, height=16)[2]["n_visible"] == [1]


@pytest.mark.parametrize(
    "options",
    [
        Options(exact_tiles=False),
        Options(opacity_extent=False),
        Options(stop_early=False),
        Options(cull_offscreen=False),
        Options(exact_tiles=False, opacity_extent=False, stop_early=False, cull_offscreen=False),
    ],
)
def test_skips_change_no_pixel(options: Options) -> None:
    scene = random_scene()
    scene["opacities"][:100] *= 0.1
    scene["scales"][100:150] *= torch.tensor([40.0, 0.01, 0.01])  # needles: their bounding boxes reach far beyond them
    image, gradients, meta = render_with_gradients(scene, 61, 47)
    other, other_gradients, other_meta = render_with_gradients(scene, 61, 47, options=options)
    assert torch.equal(image, other)
    for name, gradient in gradients.items():
        assert float((gradient - other_gradients[name]).norm()) <= 1e-5 * float(gradient.norm()), name
    assert other_meta["n_pairs"][0] >= meta["n_pairs"][0]


@pytest.mark.parametrize(
    "options", [Options(alpha_min=1 / 512), Options(transmittance_min=1e-2), Options(alpha_min=1e-5)]
)
def test_thresholds_match_the_oracle(options: Options) -> None:
    assert_close(compare(random_scene(count=200), 64, 64, options=options))


@pytest.mark.parametrize(("degree", "error"), [(3, 2e-3), (4, 1e-4)])
def test_short_exponentials_are_a_little_off(degree: int, error: float) -> None:
    scene = random_scene(count=200)
    image = rasterization(**scene, width=64, height=64)[0]
    short = rasterization(**scene, width=64, height=64, options=Options(exp_degree=degree))[0]
    assert 1e-7 < float((short - image).abs().mean()) < error


def test_counters_state_what_skips_saved() -> None:
    scene = random_scene(count=50, width=160, height=160)
    scene["scales"] *= 0.3
    counted = rasterization(**scene, width=160, height=160, options=Options(count_skips=True))[2]
    box = rasterization(**scene, width=160, height=160, options=Options(exact_tiles=False))[2]["n_pairs"][0]
    culled = counted["n_culled"][0]
    assert abs(counted["n_pairs"][0] + culled["box_pairs"] - box) <= 0.1 * box
    assert culled["empty_tiles"] > 100


@pytest.mark.parametrize(
    "value", [{"alpha_min": 0.0}, {"transmittance_min": 1.0}, {"exp_degree": 6}, {"list_width": 3}]
)
def test_options_out_of_range_are_named(value: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(value))):
        Options(**value)


def test_semantics_are_checked() -> None:
    with pytest.raises(ValueError, match="semantics"):
        Settings(8, 8, semantics="other").check()


def test_every_camera_may_have_its_own_colors() -> None:
    scene = random_scene(count=60, cameras=2)
    own = torch.stack([scene["colors"], scene["colors"].flip(0)])
    both = rasterization(**(scene | {"colors": own}), width=32, height=32)[0]
    for i in range(2):
        alone = rasterization(**(scene | {"colors": own[i]}), width=32, height=32)[0]
        assert torch.equal(both[i], alone[i])


def test_conics_are_the_inverse_covariances() -> None:
    scene = random_scene(count=100)
    meta = rasterization(**scene, width=64, height=64, packed=False)[2]
    settings = Settings(64, 64)
    splats = reference.Splats(**{k: v.double() for k, v in scene.items()})
    p = reference.project(splats, splats.viewmats[0], splats.Ks[0], settings)
    wanted = torch.stack([p.covariance[:, 2], -p.covariance[:, 1], p.covariance[:, 0]], -1) / p.determinant[:, None]
    assert torch.allclose(meta["conics"][0].double(), wanted, rtol=1e-3, atol=1e-5)
    assert {"means2d", "radii", "n_pairs", "width", "opacities"} <= set(meta)


@pytest.mark.parametrize("semantics", ["gsplat", "inria"])
@pytest.mark.parametrize(
    "options", [Options(list_width=2), Options(list_width=4), Options(list_width=2, exact_tiles=False)]
)
def test_shared_lists_are_shorter_and_change_no_pixel(options: Options, semantics: str) -> None:
    scene = random_scene(width=61, height=47)
    scene["scales"][100:150] *= torch.tensor([40.0, 0.01, 0.01])
    image, gradients, meta = render_with_gradients(scene, 61, 47, semantics=semantics)
    shared, shared_gradients, shared_meta = render_with_gradients(scene, 61, 47, semantics=semantics, options=options)
    assert torch.equal(image, shared)
    for name, gradient in gradients.items():
        assert float((gradient - shared_gradients[name]).norm()) <= 1e-5 * float(gradient.norm()), name
    alone = (
        meta
        if options.exact_tiles
        else rasterization(**scene, width=61, height=47, packed=False, options=Options(exact_tiles=False))[2]
    )
    assert shared_meta["n_pairs"][0] < 0.8 * alone["n_pairs"][0]
