"""Strategies: gsplat's own run on this rasterizer, and those of this package do what gsplat's do."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from drjit_splat import rasterization
from drjit_splat.strategy import DefaultStrategy, MCMCStrategy, ops
from drjit_splat.strategy.relocation import binomials, compute_relocation

Params = dict[str, torch.nn.Parameter]
CAMERA = {"viewmats": torch.eye(4)[None], "Ks": torch.tensor([[[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]])}


def start(count: int = 80, seed: int = 0) -> tuple[Params, dict[str, torch.optim.Optimizer]]:
    """Gaussians in front of the camera, with optimizers that have taken a step."""
    g = torch.Generator().manual_seed(seed)
    values = {
        "means": torch.randn(count, 3, generator=g) * torch.tensor([0.5, 0.5, 0.2]) + torch.tensor([0.0, 0.0, 2.0]),
        "scales": torch.randn(count, 3, generator=g) * 0.5 - 4,
        "quats": torch.randn(count, 4, generator=g),
        "opacities": torch.randn(count, generator=g) * 3 - 1,
        "colors": torch.rand(count, 3, generator=g),
        "fixed": torch.rand(count, 2, generator=g),
    }
    params = {name: torch.nn.Parameter(v, requires_grad=name != "fixed") for name, v in values.items()}
    optimizers: dict[str, torch.optim.Optimizer] = {
        k: torch.optim.Adam([v], lr=1e-3) for k, v in params.items() if v.requires_grad
    }
    for name, optimizer in optimizers.items():
        params[name].grad = torch.randn(params[name].shape, generator=g)
        optimizer.step()
        optimizer.zero_grad()
    return params, optimizers


def render(params: Params, **options: Any) -> tuple[Tensor, dict[str, Any]]:
    image, _, info = rasterization(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        params["opacities"].sigmoid(),
        params["colors"],
        width=32,
        height=32,
        **CAMERA,
        **options,
    )
    return image, info


def assert_same(ours: Any, theirs: Any, tolerance: float = 0.0) -> None:
    """Equal parameters, moments and running statistics."""
    (params, optimizers, state), (their_params, their_optimizers, their_state) = ours, theirs
    for name, value in params.items():
        assert value.requires_grad == their_params[name].requires_grad
        torch.testing.assert_close(value.data, their_params[name].data, rtol=tolerance, atol=tolerance, msg=name)
        if name in optimizers:
            assert optimizers[name].param_groups[0]["params"] == [value]
            known, their_known = optimizers[name].state[value], their_optimizers[name].state[their_params[name]]
            assert known.keys() == their_known.keys() and len(known) == 3
            for key, moment in known.items():
                torch.testing.assert_close(
                    moment, their_known[key], rtol=tolerance, atol=tolerance, msg=f"{name} {key}"
                )
    for key, value in state.items():
        if isinstance(value, Tensor):
            torch.testing.assert_close(value, their_state[key], rtol=tolerance, atol=tolerance, msg=key)


def test_gsplats_default_strategy_runs_here() -> None:
    strategies = pytest.importorskip("gsplat.strategy", reason="skipped: gsplat is not installed")
    for absgrad, packed in ((False, False), (True, True)):
        ours, theirs = (
            kind(absgrad=absgrad, refine_start_iter=0, refine_every=2, grow_grad2d=1e-5, refine_scale2d_stop_iter=100)
            for kind in (DefaultStrategy, strategies.DefaultStrategy)
        )
        found = []
        for strategy in (ours, theirs):
            params, optimizers = start()
            strategy.check_sanity(params, optimizers)
            state = strategy.initialize_state(scene_scale=2.0)
            torch.manual_seed(0)
            for step in range(1, 5):
                image, info = render(params, packed=packed, absgrad=absgrad)
                strategy.step_pre_backward(params, optimizers, state, step, info)
                (image - 0.5).square().sum().backward()
                for optimizer in optimizers.values():
                    optimizer.step()
                    optimizer.zero_grad()
                strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
            found.append((params, optimizers, state))
        assert len(found[0][0]["means"]) > 80
        assert_same(*found, tolerance=1e-5)


@pytest.mark.parametrize("name", ["duplicate", "split", "revised split", "remove", "reset_opa"])
def test_edits_are_gsplats(name: str) -> None:
    theirs = pytest.importorskip("gsplat.strategy.ops", reason="skipped: gsplat is not installed")
    found = []
    for module in (ops, theirs):
        params, optimizers = start()
        state: dict[str, Any] = {"grad2d": torch.arange(80.0), "count": torch.ones(80), "scene_scale": 1.0}
        mask = torch.arange(80) % 3 == 0
        torch.manual_seed(1)
        if name == "reset_opa":
            module.reset_opa(params, optimizers, state, 0.01)
        else:
            more = {"revised_opacity": True} if name == "revised split" else {}
            getattr(module, name.split()[-1])(params, optimizers, state, mask, **more)
        found.append((params, optimizers, state))
    assert_same(*found, tolerance=1e-6)
    assert found[0][2]["scene_scale"] == 1.0


def relocation_by_the_paper(opacities: Tensor, scales: Tensor, ratios: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    """Equation 9, term by term in Python's integers and floats."""
    after, sizes = [], []
    for o, s, n in zip(opacities.tolist(), scales.tolist(), ratios.clamp(1, 51).tolist(), strict=True):
        new = 1 - (1 - o) ** (1 / n)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        after.append(new)
        sizes.append([v * o / total for v in s])
    return torch.tensor(after), torch.tensor(sizes)


def test_relocation_is_the_papers() -> None:
    g = torch.Generator().manual_seed(0)
    opacities, scales = 0.02 + 0.97 * torch.rand(60, generator=g), torch.rand(60, 3, generator=g)
    ratios = torch.cat([torch.arange(1, 52), torch.tensor([60, 2, 2, 2, 3, 3, 3, 4, 4])])
    found = compute_relocation(opacities, scales, ratios, binomials(), 0.0)
    wanted = relocation_by_the_paper(opacities, scales, ratios)
    assert torch.allclose(found[0], wanted[0], rtol=1e-5) and torch.allclose(found[1], wanted[1], rtol=1e-4)
    # What several of them show together along a ray through their centre is what one showed.
    assert torch.allclose(1 - (1 - found[0]) ** ratios.clamp(max=51), opacities, rtol=1e-4)


@pytest.mark.parametrize("name", ["relocate", "sample_add", "inject_noise_to_position"])
def test_moves_are_gsplats(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = pytest.importorskip("gsplat.strategy.ops", reason="skipped: gsplat is not installed")
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

    # These two of its parts need its CUDA extension.
    monkeypatch.setattr(theirs, "compute_relocation", lambda **a: relocation_by_the_paper(*a.values()))
    monkeypatch.setattr(theirs, "quat_scale_to_covar_preci", _quat_scale_to_covar_preci)
    found = []
    for module in (ops, theirs):
        params, optimizers = start()
        state: dict[str, Any] = {}
        torch.manual_seed(2)
        if name == "relocate":
            dead = params["opacities"].detach().sigmoid() < 0.1
            assert 10 < int(dead.sum()) < 70
            module.relocate(params, optimizers, state, dead, binomials(), 0.005)
        elif name == "sample_add":
            module.sample_add(params, optimizers, state, 13, binomials(), 0.005)
        else:
            module.inject_noise_to_position(params, optimizers, state, scaler=500.0)
        found.append((params, optimizers, state))
    assert_same(*found, tolerance=2e-4)
    assert not torch.equal(found[0][0]["means"], start()[0]["means"])


@pytest.mark.parametrize("column", [False, True])
def test_mcmc_moves_the_dead_and_grows_to_its_cap(column: bool) -> None:
    params, optimizers = start()
    if column:
        params["opacities"] = torch.nn.Parameter(params["opacities"].detach()[:, None])
        optimizers["opacities"] = torch.optim.Adam([params["opacities"]])
    strategy = MCMCStrategy(cap_max=83, refine_start_iter=0, refine_every=1, noise_lr=10.0, noise_injection_stop_iter=3)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    with torch.no_grad():
        params["opacities"][:7] = -9.0
    for step in (1, 2):
        strategy.step_post_backward(params, optimizers, state, step, {}, lr=1e-3)
    assert len(params["means"]) == 83 and all(len(p) == 83 for p in params.values())
    assert (params["opacities"].sigmoid() >= 0.005 - 1e-6).all()
    before = params["means"].detach().clone()
    MCMCStrategy(noise_injection_stop_iter=3, refine_stop_iter=0).step_post_backward(
        params, optimizers, state, 3, {}, lr=1.0
    )
    assert torch.equal(params["means"], before)
    with torch.no_grad():
        params["opacities"].fill_(-20.0)  # nobody lives
    MCMCStrategy(refine_start_iter=0, refine_every=1, cap_max=1).step_post_backward(
        params, optimizers, state, 4, {}, 0.0
    )
    assert len(params["means"]) == 83


def test_opacities_are_reset_and_huge_ones_pruned() -> None:
    params, optimizers = start()
    with torch.no_grad():
        params["scales"].clamp_(max=-3.0)
        params["scales"][:5] = 1.0
    strategy = DefaultStrategy(reset_every=4, refine_start_iter=0, refine_every=4, grow_grad2d=1e9, prune_opa=1e-6)
    state = strategy.initialize_state()
    for step in (4, 8):
        image, info = render(params, packed=False)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        image.sum().backward()
        strategy.step_post_backward(params, optimizers, state, step, info)
    assert len(params["means"]) == 75
    assert (params["opacities"].sigmoid() <= 2e-6 * 1.01).all()
    strategy = DefaultStrategy(refine_stop_iter=3)
    unchanged = copy.deepcopy(params)
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 3, {})
    assert all(torch.equal(params[k], unchanged[k]) for k in params)


def test_what_does_not_fit_together_is_named() -> None:
    params, optimizers = start()
    with pytest.raises(AssertionError, match="fixed"):
        DefaultStrategy().check_sanity(params, optimizers | {"fixed": optimizers["means"]})
    with pytest.raises(AssertionError, match="'quats'"):
        MCMCStrategy().check_sanity(
            {k: v for k, v in params.items() if k != "quats"}, {k: v for k, v in optimizers.items() if k != "quats"}
        )
    image, info = render(params, packed=False)
    image.sum().backward()
    with pytest.raises(ValueError, match="step_pre_backward"), pytest.warns(UserWarning, match="not a leaf"):
        DefaultStrategy().step_post_backward(params, optimizers, DefaultStrategy().initialize_state(), 1, info)
