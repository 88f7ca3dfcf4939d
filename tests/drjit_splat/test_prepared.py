"""Geometry prepared once and shaded many times."""

from __future__ import annotations

import drjit as dr
import pytest
import torch

from drjit_splat import prepare, profile, rasterization

from .common import random_scene

GEOMETRY = ("means", "quats", "scales", "opacities", "viewmats", "Ks")


def close(a: torch.Tensor, b: torch.Tensor) -> None:
    assert float((a - b).norm()) <= 1e-5 * float(b.norm())


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_shading_equals_rendering(mode: str) -> None:
    scene = random_scene(cameras=2, channels=9)
    prepared = prepare(*(scene[k] for k in GEOMETRY), 64, 48, rasterize_mode=mode, render_mode="RGB+ED")
    colors = scene["colors"].flip(0).requires_grad_()
    image, alpha, meta = prepared.shade(colors, backgrounds=scene["backgrounds"])
    arguments = scene | {"colors": colors.detach().clone().requires_grad_()}
    expected = rasterization(**arguments, width=64, height=48, packed=False, rasterize_mode=mode, render_mode="RGB+ED")
    assert float((image - expected[0]).detach().abs().max()) < 1e-5
    assert torch.equal(meta["radii"], expected[2]["radii"])
    weight = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    image.backward(weight)
    expected[0].backward(weight)
    assert colors.grad is not None
    close(colors.grad, arguments["colors"].grad)
    assert alpha.shape == (2, 48, 64, 1)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_opacities_may_change_when_prepared_for_it(mode: str) -> None:
    scene = random_scene()
    geometry = [scene[k] for k in GEOMETRY]
    geometry[3] = torch.ones_like(scene["opacities"])
    prepared = prepare(*geometry, 64, 64, opacities_change=True, rasterize_mode=mode)
    leaves = {k: scene[k].clone().requires_grad_() for k in ("colors", "opacities")}
    image = prepared.shade(leaves["colors"], leaves["opacities"])[0]
    wanted = {k: scene[k].clone().requires_grad_() for k in ("colors", "opacities")}
    expected = rasterization(**(scene | wanted | {"backgrounds": None}), width=64, height=64, rasterize_mode=mode)[0]
    assert float((image - expected).detach().abs().max()) < 2e-5
    image.square().sum().backward()
    expected.square().sum().backward()
    for name in leaves:
        a, b = leaves[name].grad, wanted[name].grad
        assert a is not None and b is not None
        assert float((a - b).norm()) <= 2e-4 * float(b.norm()), name


def test_shading_skips_what_colours_cannot_change() -> None:
    scene = random_scene()
    prepared = prepare(*(scene[k] for k in GEOMETRY), 64, 64)
    colors = scene["colors"].requires_grad_()
    with profile() as report:
        prepared.shade(colors)[0].sum().backward()
    assert {"project", "sort", "emit", "bin"}.isdisjoint(report.stages)
    assert {"blend", "blend backward"} <= set(report.stages)


def test_fixed_opacities_are_refused_and_bad_colours_named() -> None:
    scene = random_scene(count=20)
    prepared = prepare(*(scene[k] for k in GEOMETRY), 16, 16)
    with pytest.raises(ValueError, match="opacities_change"):
        prepared.shade(scene["colors"], scene["opacities"])
    with pytest.raises(ValueError, match="colors"):
        prepared.shade(scene["colors"][:5])
    with pytest.raises(ValueError, match="render_mode"):
        prepare(*(scene[k] for k in GEOMETRY), 16, 16, render_mode="D")


def test_nothing_visible_can_be_shaded() -> None:
    scene = random_scene(count=20)
    scene["means"] = scene["means"] - 100
    colors = scene["colors"].requires_grad_()
    image = prepare(*(scene[k] for k in GEOMETRY), 16, 16).shade(colors)[0]
    image.sum().backward()
    assert image.abs().max() == 0
    assert colors.grad is not None and not colors.grad.any()


def test_profile_lists_stages_and_kernels() -> None:
    scene = {k: v.requires_grad_() for k, v in random_scene(count=100).items()}
    rasterization(**scene, width=32, height=32)[0].sum().backward()
    with profile() as report:
        rasterization(**scene, width=32, height=32)[0].sum().backward()
    assert report.compiled == 0
    assert 5 < report.launched < 40
    assert {"project", "sort", "emit", "bin", "lists", "blend", "blend backward", "projection backward"} <= set(
        report.stages
    )
    assert all(spent > 0 for spent in report.stages.values())
    assert not dr.flag(dr.JitFlag.KernelHistory)
