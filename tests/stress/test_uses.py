"""Catalogue lines 7, 10, 22 to 24 and 27 to 32 over families of scenes, and every way in which a call may be used."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from drjit_splat import rasterization, reference
from tests.drjit_splat.common import assert_close, compare, one_splat, random_scene, render_with_gradients

from .conftest import Worst
from .scenes import noted

SEEDS = st.integers(0, 2**31)


@given(seed=SEEDS, angle=st.floats(0.1, 1.4), stretch=st.floats(1.5, 30))
def test_07_gradient_through_the_conics_off_diagonal(worst: Worst, seed: int, angle: float, stretch: float) -> None:
    half = angle / 2
    scene = one_splat(scales=[[0.1 * stretch, 0.1, 0.1]], quats=[[math.cos(half), 0, 0, math.sin(half)]])
    scene["means"][0, :2] = 0.2 * torch.randn(2, generator=torch.Generator().manual_seed(seed))
    assert_close(noted(worst, compare(scene, 16, 16)))


@given(seed=SEEDS, x=st.floats(-0.8, 1.8), y=st.floats(-0.8, 1.8))
def test_10_principal_point_anywhere(worst: Worst, seed: int, x: float, y: float) -> None:
    scene = random_scene(100, 32, 32, seed=seed)
    scene["Ks"][:, 0, 2], scene["Ks"][:, 1, 2] = 32 * x, 32 * y
    scene["means"][:, 0] -= 2.0 * (x - 0.45) / 1.1
    scene["means"][:, 1] -= 2.0 * (y - 0.57) / 1.05
    c = noted(worst, compare(scene, 32, 32))
    assert c.meta["n_visible"][0] > 20
    assert_close(c, gradient=2e-4)


@pytest.mark.parametrize("channels", [1, 3, 4, 32])
def test_22_channels_do_not_touch_each_other(channels: int) -> None:
    scene = random_scene(60, 32, 32, channels=channels)
    together = rasterization(**scene, width=32, height=32)[0]
    alone = scene | {"colors": scene["colors"][:, :1], "backgrounds": scene["backgrounds"][:, :1]}
    assert torch.equal(together[..., :1], rasterization(**alone, width=32, height=32)[0])
    assert torch.isfinite(together).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (5, 3), (31, 33)])
def test_23_sizes_that_do_not_fit_tiles(worst: Worst, width: int, height: int) -> None:
    c = noted(worst, compare(random_scene(80, width, height), width, height))
    assert c.image < 2e-5 and max(c.gradients.values()) < 1e-3


@given(seed=SEEDS)
def test_24_shuffled_splats_make_the_same_image(seed: int) -> None:
    scene = random_scene(150, 32, 32, seed=seed)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(seed))
    shuffled = {k: v[order] if len(v) == 150 else v for k, v in scene.items()}
    depths = rasterization(**scene, width=32, height=32, packed=False)[2]["depths"][0]
    if len(depths.unique()) == len(depths):
        image = rasterization(**scene, width=32, height=32)[0]
        assert torch.equal(image, rasterization(**shuffled, width=32, height=32)[0])


def test_27_popping_along_an_orbit_is_no_more_than_a_splat(worst: Worst) -> None:
    """Sorting by centre depth pops by nature; the size of a step must vanish with the step where no order changes."""
    scene = random_scene(200, 32, 32)
    scene.pop("backgrounds")
    largest, smooth = 0.0, 0.0
    last: tuple[Tensor, Tensor] | None = None
    for step in range(60):
        angle = step * 1e-4
        turn = torch.eye(4)
        turn[0, 0] = turn[2, 2] = math.cos(angle)
        turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
        turned = scene | {"viewmats": scene["viewmats"] @ turn}
        image, _, meta = rasterization(**turned, width=32, height=32, packed=False)
        order = meta["depths"][0].argsort()
        if last is not None:
            change = float((image - last[0]).abs().max())
            if torch.equal(order, last[1]):
                smooth = max(smooth, change)
            else:
                largest = max(largest, change)
        last = (image, order)
    worst("step with a swap", largest)
    assert worst("step without a swap", smooth) < 0.02
    assert largest < 0.5


@pytest.mark.slow
def test_28_runs_and_numbers_of_threads(worst: Worst) -> None:
    code = (
        "import hashlib, json, sys, torch, drjit as dr; from tests.drjit_splat.common import *;"
        "from drjit_splat.llvm import require; require(); dr.set_thread_count(int(sys.argv[1]));"
        "runs = [render_with_gradients(random_scene(), 64, 64) for _ in range(3)];"
        "digest = lambda r: hashlib.sha256(r[0].numpy().tobytes()).hexdigest();"
        "print(json.dumps([[digest(r) for r in runs], {k: v.flatten().tolist() for k, v in runs[0][1].items()},"
        "max(float((a[1][k] - runs[0][1][k]).abs().max()) for a in runs for k in a[1])]))"
    )
    found = []
    for threads in ("1", str(os.cpu_count())):
        done = subprocess.run([sys.executable, "-c", code, threads], capture_output=True, text=True, check=True)
        found.append(json.loads(done.stdout))
    assert len({digest for digests, _, _ in found for digest in digests}) == 1
    assert worst("gradients between runs", max(f[2] for f in found)) == 0
    for name, values in found[0][1].items():
        a, b = torch.tensor(values), torch.tensor(found[1][1][name])
        assert worst("gradients between thread counts", float((a - b).norm() / a.norm())) < 1e-6, name


@given(seed=SEEDS, form=st.sampled_from(["strided", "expanded", "transposed", "sliced"]))
def test_29_gradients_that_are_not_contiguous(seed: int, form: str) -> None:
    scene = random_scene(50, 32, 32, seed=seed)
    g = torch.Generator().manual_seed(seed)
    weight = {
        "strided": torch.randn(1, 32, 32, 6, generator=g)[..., ::2],
        "expanded": torch.randn(1, 1, 32, 1, generator=g).expand(1, 32, 32, 3),
        "transposed": torch.randn(1, 3, 32, 32, generator=g).permute(0, 2, 3, 1),
        "sliced": torch.randn(1, 40, 32, 3, generator=g)[:, 4:36],
    }[form]
    assert not weight.is_contiguous()
    found = []
    for gradient in (weight, weight.contiguous()):
        leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
        rasterization(**leaves, width=32, height=32)[0].backward(gradient)
        found.append({k: v.grad for k, v in leaves.items()})
    for name, gradient in found[0].items():
        other = found[1][name]
        assert gradient is not None and other is not None
        assert float((gradient - other).norm()) <= 1e-6 * float(other.norm()), name


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.complex64])
def test_30_numbers_that_are_no_floats_are_named(dtype: torch.dtype) -> None:
    scene = random_scene(5, 16, 16)
    with pytest.raises(ValueError, match=r"^means"):
        rasterization(**(scene | {"means": scene["means"].to(dtype)}), width=16, height=16)


def test_30_nothing_asked_for_keeps_nothing() -> None:
    image, alpha, _ = rasterization(**random_scene(20, 16, 16), width=16, height=16)
    assert not image.requires_grad and not alpha.requires_grad


@pytest.mark.slow
def test_31_memory_of_an_optimisation_is_flat(worst: Worst) -> None:
    def resident() -> int:
        with open("/proc/self/statm") as file:  # noqa: PTH123
            return int(file.read().split()[1]) * 4096

    scene = {k: v.requires_grad_(k != "viewmats") for k, v in random_scene(500).items()}
    target = torch.zeros(1, 64, 64, 3)
    sizes = []
    for step in range(200):
        loss = (rasterization(**scene, width=64, height=64)[0] - target).square().mean()
        loss.backward()
        with torch.no_grad():
            scene["colors"].sub_(0.1 * scene["colors"].grad)
        for leaf in scene.values():
            leaf.grad = None
        if step in (60, 199):
            sizes.append(resident())
    assert worst("MiB grown in 140 steps", (sizes[1] - sizes[0]) / 2**20) < 16


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"])
def test_32_every_input_edited_in_place_is_noticed(name: str) -> None:
    scene: dict[str, Any] = {k: v.requires_grad_() * 1 for k, v in random_scene(20, 16, 16).items()}
    image = rasterization(**scene, width=16, height=16)[0]
    with torch.no_grad():
        scene[name].mul_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_an_old_llvm_is_refused_before_it_is_loaded(tmp_path: Path) -> None:
    library = tmp_path / "libLLVM-14.so.1"
    library.touch()
    code = "from drjit_splat.llvm import require; require()"
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(library)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "jit_llvm_init" not in done.stderr
    assert "is LLVM 14, but 16 or newer is needed" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("mode", ["RGB+ED", "D"])
def test_gradients_do_not_depend_on_who_else_asks(mode: str) -> None:
    scene = random_scene(100, 32, 32, cameras=2)
    if mode == "D":
        del scene["colors"], scene["backgrounds"]
        scene["colors"] = torch.zeros(100, 1)
    _, wanted, _ = render_with_gradients(scene, 32, 32, render_mode=mode)
    for name in scene:
        leaves = {k: v.clone().requires_grad_(k == name) for k, v in scene.items()}
        image, alpha, _ = rasterization(**leaves, width=32, height=32, render_mode=mode)
        if wanted[name] is None:
            assert not image.requires_grad
            continue
        (image.sum() + alpha.sum()).backward()
        found = leaves[name].grad
        assert found is not None and all(v.grad is None for k, v in leaves.items() if k != name)
        assert float((found - wanted[name]).norm()) <= 1e-5 * float(wanted[name].norm()), name


def test_checkpointed_calls_have_the_same_gradients() -> None:
    scene = random_scene(100, 32, 32)
    names = list(scene)
    _, wanted, _ = render_with_gradients(scene, 32, 32)

    def image_and_coverage(*values: Tensor) -> Tensor:
        found = rasterization(**dict(zip(names, values, strict=True)), width=32, height=32)
        return found[0].sum() + found[1].sum()

    leaves = [v.clone().requires_grad_() for v in scene.values()]
    total: Any = checkpoint(image_and_coverage, *leaves, use_reentrant=False)
    total.backward()
    for name, leaf in zip(names, leaves, strict=True):
        assert leaf.grad is not None and torch.equal(leaf.grad, wanted[name]), name


@given(seed=SEEDS, mode=st.sampled_from(["RGB+D", "RGB+ED"]), degree=st.sampled_from([None, 0, 2]))
def test_oracle_matches_finite_differences(worst: Worst, seed: int, mode: str, degree: int | None) -> None:
    scene = {k: v.double() for k, v in random_scene(8, 6, 5, seed=seed).items()}
    scene["scales"] *= 4
    options: dict[str, Any] = {"width": 6, "height": 5, "render_mode": mode, "sh_degree": degree}
    g = torch.Generator().manual_seed(seed)
    if degree is not None:
        scene["colors"] = 1 + 0.1 * torch.randn(8, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64)
    options["decisions"] = reference.rasterization(**scene, **options)[2]["decisions"]

    def loss(values: dict[str, Tensor]) -> Tensor:
        image, alpha, _ = reference.rasterization(**values, **options)
        return image.square().sum() + alpha.sum()

    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    loss(leaves).backward()
    for name, leaf in leaves.items():
        direction = torch.randn(leaf.shape, generator=g, dtype=torch.float64)
        if name == "Ks":
            direction *= torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]])
        direction *= 1e-6 / direction.norm()
        with torch.no_grad():
            numeric = loss(scene | {name: scene[name] + direction}) - loss(scene | {name: scene[name] - direction})
            assert leaf.grad is not None
            analytic = 2 * (leaf.grad * direction).sum()
        error = float((numeric - analytic).abs() / (1e-6 * (1 + leaf.grad.norm())))
        assert worst("difference", error) < 1e-5, name
