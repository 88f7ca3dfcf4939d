"""Batches, sparse gradients, many channels, integers of all kinds, and callers that compile or cast."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from drjit_splat import prepare, rasterization, reference

from .common import assert_close, compare, random_scene

SIZE = {"width": 30, "height": 20}


def batched(batch: tuple[int, ...], **options: Any) -> tuple[list[dict[str, Tensor]], dict[str, Tensor]]:
    """Single scenes, and all of them as one batch."""
    count = int(np.prod(batch))
    single = [random_scene(count=60, cameras=2, seed=seed, **SIZE, **options) for seed in range(count)]
    return single, {k: torch.stack([s[k] for s in single]).view(*batch, *single[0][k].shape) for k in single[0]}


@pytest.mark.parametrize("batch", [(2,), (1, 2), (1,)])
@pytest.mark.parametrize("packed", [True, False])
def test_a_batch_is_its_elements(batch: tuple[int, ...], packed: bool) -> None:
    single, together = batched(batch)
    leaves = {k: v.clone().requires_grad_() for k, v in together.items()}
    image, alpha, meta = rasterization(**leaves, **SIZE, packed=packed, render_mode="RGB+ED")
    assert image.shape == (*batch, 2, 20, 30, 4) and alpha.shape == (*batch, 2, 20, 30, 1)
    assert meta["n_batches"] == len(single) and meta["n_cameras"] == 2
    weight = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    image.backward(weight)
    for b, scene in enumerate(single):
        own = {k: v.clone().requires_grad_() for k, v in scene.items()}
        expected, covered, own_meta = rasterization(**own, **SIZE, packed=packed, render_mode="RGB+ED")
        expected.backward(weight.view(len(single), *expected.shape)[b])
        assert torch.equal(image.view(len(single), *expected.shape)[b], expected)
        assert torch.equal(alpha.view(len(single), *covered.shape)[b], covered)
        for name, leaf in own.items():
            found = leaves[name].grad.view(len(single), *leaf.shape)[b]  # type: ignore[union-attr]
            assert torch.allclose(found, leaf.grad, rtol=1e-4, atol=1e-6 * float(leaf.grad.abs().max())), name  # type: ignore
        if packed:
            rows = meta["batch_ids"] == b
            assert torch.equal(meta["gaussian_ids"][rows], own_meta["gaussian_ids"])
            assert torch.equal(meta["means2d"][rows], own_meta["means2d"])
        else:
            assert torch.equal(meta["radii"].view(len(single), 2, 60, 2)[b], own_meta["radii"])


def test_the_oracle_takes_batches() -> None:
    _, together = batched((2,))
    image, alpha, meta = rasterization(**together, **SIZE, packed=False)
    order = meta["depths"].argsort(dim=-1, stable=True)
    wanted, covered, expected = reference.rasterization(**together, **SIZE, order=order)
    trusted = (expected["margin"] > 1e-4)[..., None]
    assert wanted.shape == image.shape and float(((image - wanted).abs() * trusted).max()) < 2e-5
    assert float(((alpha - covered).abs() * trusted).max()) < 2e-5


def test_harmonics_may_be_shared_by_a_batch() -> None:
    _, together = batched((2,))
    harmonics = 0.3 * torch.randn(60, 4, 3, generator=torch.Generator().manual_seed(1))
    shared = harmonics.clone().requires_grad_()
    image = rasterization(**(together | {"colors": shared}), **SIZE, sh_degree=1)[0]
    own = harmonics.repeat(2, 1, 1, 1).requires_grad_()
    expected = rasterization(**(together | {"colors": own}), **SIZE, sh_degree=1)[0]
    each = harmonics.repeat(2, 2, 1, 1, 1)
    assert torch.equal(image, expected)
    assert torch.equal(image, rasterization(**(together | {"colors": each}), **SIZE, sh_degree=1)[0])
    image.sum().backward()
    expected.sum().backward()
    assert shared.grad is not None and own.grad is not None
    assert torch.allclose(shared.grad, own.grad.sum(0), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("cameras", [1, 2])
def test_sparse_gradients_are_the_dense_ones(cameras: int) -> None:
    scene = random_scene(count=200, cameras=cameras, **SIZE)
    scene["means"][::3] += 100
    found = []
    for sparse in (True, False):
        leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
        rasterization(**leaves, **SIZE, sparse_grad=sparse)[0].square().sum().backward()
        found.append(leaves)
    for name, leaf in found[0].items():
        assert leaf.grad.is_sparse == (name in ("means", "quats", "scales")), name  # type: ignore[union-attr]
        want = found[1][name].grad  # on a busy machine threads add up in another order
        assert torch.allclose(leaf.grad.to_dense(), want, rtol=1e-5, atol=1e-6 * float(want.abs().max())), name  # type: ignore
    assert found[0]["means"].grad._nnz() < 140  # type: ignore[union-attr]
    torch.optim.SparseAdam([found[0]["means"]]).step()
    with pytest.raises(ValueError, match="sparse_grad"):
        rasterization(**batched((2,))[1], **SIZE, sparse_grad=True)
    dense = {k: v.clone().requires_grad_() for k, v in scene.items()}
    rasterization(**dense, **SIZE, packed=False, sparse_grad=True)[0].sum().backward()
    assert not dense["means"].grad.is_sparse  # type: ignore[union-attr]


def test_any_number_of_channels() -> None:
    assert_close(compare(random_scene(count=60, channels=41, **SIZE), 30, 20, render_mode="RGB+D"))
    scene = random_scene(count=5, channels=40, **SIZE)
    scene["colors"][3, 38] = torch.nan
    with pytest.raises(ValueError, match=r"colors\[3, 38\]"):
        rasterization(**scene, **SIZE)


def test_harmonics_of_degree_four() -> None:
    scene = random_scene(count=60, **SIZE)
    scene["colors"] = 0.2 * torch.randn(60, 25, 3, generator=torch.Generator().manual_seed(7))
    assert_close(compare(scene, 30, 20, sh_degree=4))
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="skipped: gsplat is not installed")
    from drjit_splat._harmonics import basis

    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(8)), dim=-1)
    assert torch.allclose(basis(directions, 4), gsplat._eval_sh_bases_fast(25, directions), atol=1e-6)


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depth_needs_no_colors(mode: str) -> None:
    scene = random_scene(count=60, **SIZE)
    expected = rasterization(**scene, **SIZE, render_mode=mode)[0]
    assert torch.equal(rasterization(**(scene | {"colors": None}), **SIZE, render_mode=mode)[0], expected)
    with pytest.raises(ValueError, match=r"^colors "):
        rasterization(**(scene | {"colors": None}), **SIZE)


@pytest.mark.parametrize("kind", [np.int64, np.uint16, torch.tensor])
def test_integers_of_any_kind(kind: Any) -> None:
    scene = random_scene(count=20, **SIZE)
    image = rasterization(**scene, width=kind(30), height=kind(20))[0]
    assert torch.equal(image, rasterization(**scene, **SIZE)[0])
    for wrong in (True, 30.0, "30", np.float32(30)):
        with pytest.raises(ValueError, match=r"^width must be an integer"):
            rasterization(**scene, width=wrong, height=20)  # type: ignore[arg-type]


def test_gsplats_order_of_arguments() -> None:
    scene = random_scene(count=20, **SIZE)
    background = scene.pop("backgrounds")
    given = (*scene.values(), 30, 20, 0.01, 1e10, 0.0, 0.3, None, False, 16, background, "RGB+D", False, True)
    image, _, meta = rasterization(*given, "antialiased", 32, False, "pinhole", False, None, False, False)
    named = {"packed": False, "backgrounds": background, "render_mode": "RGB+D", "rasterize_mode": "antialiased"}
    assert torch.equal(image, rasterization(**scene, **SIZE, **named)[0])
    assert meta["means2d"].shape == (1, 20, 2)


def test_casting_callers_get_single_precision() -> None:
    scene = random_scene(count=60, **SIZE)
    scene["colors"] = 0.3 * torch.randn(60, 16, 3, generator=torch.Generator().manual_seed(1))
    expected = rasterization(**scene, **SIZE, sh_degree=3)[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(rasterization(**scene, **SIZE, sh_degree=3)[0], expected)


@pytest.mark.filterwarnings("ignore:The .grad attribute")  # of what torch carries over a break in its graph
def test_compiled_callers_get_the_same_image() -> None:
    scene = random_scene(count=60, **SIZE)
    colors = scene.pop("colors").requires_grad_()
    prepared = prepare(*(scene[k] for k in ("means", "quats", "scales", "opacities", "viewmats", "Ks")), 30, 20)

    def loss(colors: Tensor) -> Tensor:
        image = rasterization(**scene, colors=2 * colors, **SIZE)[0]
        return image.square().sum() + prepared.shade(colors)[0].sum()

    expected = loss(colors)
    wanted = torch.autograd.grad(expected, colors)[0]
    found = torch.compile(loss, backend="eager")(colors)
    assert torch.equal(found, expected)
    assert torch.allclose(torch.autograd.grad(found, colors)[0], wanted, rtol=1e-5, atol=1e-6)


def test_rendering_does_not_load_the_compiler() -> None:
    code = (
        "import sys; from drjit_splat import rasterization; from tests.drjit_splat.common import one_splat;"
        "rasterization(**one_splat(), width=8, height=8); print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
