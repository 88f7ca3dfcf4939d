"""The same rasterizer on Dr.Jit arrays."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch

from drjit_splat import rasterization
from drjit_splat.llvm import require

require()

import drjit as dr  # noqa: E402
from drjit.llvm.ad import TensorXf  # noqa: E402

from drjit_splat import drjit_api  # noqa: E402

from .common import random_scene  # noqa: E402


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"render_mode": "RGB+ED"},
        {"render_mode": "D"},
        {"rasterize_mode": "antialiased", "semantics": "inria"},
        {"sh_degree": 3},
    ],
)
def test_image_and_gradients_equal_those_through_torch(options: dict[str, Any]) -> None:
    scene = random_scene(cameras=2)
    if "sh_degree" in options:
        scene["colors"] = 0.3 * torch.randn(500, 16, 3, generator=torch.Generator().manual_seed(1))
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    expected, coverage, _ = rasterization(**leaves, width=64, height=48, **options)
    tensors = {k: TensorXf(v.numpy()) for k, v in scene.items()}
    dr.enable_grad(list(tensors.values()))
    image, alpha = drjit_api.rasterization(**tensors, width=64, height=48, **options)
    assert image.shape == tuple(expected.shape)
    assert abs(image.numpy() - expected.detach().numpy()).max() < 1e-6
    assert abs(alpha.numpy() - coverage.detach().numpy()).max() == 0
    weight = torch.randn(expected.shape, generator=torch.Generator().manual_seed(5))
    (expected * weight).sum().backward()
    dr.backward(dr.sum(image * TensorXf(weight.numpy())))
    for name, leaf in leaves.items():
        got = torch.from_numpy(dr.grad(tensors[name]).numpy().copy())
        if leaf.grad is None:
            assert not got.any(), name
        else:
            assert float((got - leaf.grad).norm()) <= 1e-5 * float(leaf.grad.norm()), name


def test_many_channels_and_no_splats() -> None:
    scene = random_scene(count=50, channels=9)
    image = drjit_api.rasterization(**{k: TensorXf(v.numpy()) for k, v in scene.items()}, width=20, height=20)[0]
    expected = rasterization(**scene, width=20, height=20)[0]
    assert abs(image.numpy() - expected.numpy()).max() < 1e-6
    scene["means"] = scene["means"] - 100
    empty = drjit_api.rasterization(**{k: TensorXf(v.numpy()) for k, v in scene.items()}, width=20, height=20)
    assert abs(empty[1].numpy()).max() == 0


def test_bad_tensors_are_named() -> None:
    scene = {k: TensorXf(v.numpy()) for k, v in random_scene(count=20).items()}
    with pytest.raises(ValueError, match=r"^scales must have the shape \[N, 3\]"):
        drjit_api.rasterization(**(scene | {"scales": scene["quats"]}), width=8, height=8)
    with pytest.raises(ValueError, match=r"^means must be a Dr\.Jit tensor"):
        drjit_api.rasterization(**(scene | {"means": [1.0]}), width=8, height=8)
    bad = random_scene(count=20)["opacities"]
    bad[3] = torch.nan
    with pytest.raises(ValueError, match=r"opacities\[3\] is nan"):
        drjit_api.rasterization(**(scene | {"opacities": TensorXf(bad.numpy())}), width=8, height=8)


def test_torch_is_not_needed() -> None:
    code = "import sys; import drjit_splat.drjit_api; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
