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


def test_cameras_are_checked_as_through_torch() -> None:
    scene = random_scene(count=20)
    turned = scene["viewmats"].mT

    def intrinsics(row: int, column: int, value: float) -> torch.Tensor:
        changed = scene["Ks"].clone()
        changed[0, row, column] = value
        return changed

    cases: list[tuple[str, torch.Tensor, str]] = [
        ("Ks", intrinsics(0, 1, 9.0), r"skew \(9"),
        ("Ks", intrinsics(1, 1, -60.0), "positive focal lengths"),
        ("Ks", intrinsics(0, 0, torch.nan), r"Ks\[0, 0, 0\] is nan"),
        ("viewmats", turned, "is it transposed"),
        ("viewmats", scene["viewmats"] * torch.inf, r"viewmats\[0, 0, 0\] is inf"),
        ("backgrounds", scene["backgrounds"] * torch.nan, r"backgrounds\[0, 0\] is nan"),
    ]
    for name, value, message in cases:
        for kind in (rasterization, drjit_api.rasterization):
            arguments: dict[str, Any] = scene | {name: value}
            if kind is drjit_api.rasterization:
                arguments = {k: TensorXf(v.contiguous().numpy()) for k, v in arguments.items()}
            with pytest.raises(ValueError, match=message):
                kind(**arguments, width=8, height=8)


def test_other_arguments_are_checked_as_through_torch() -> None:
    import numpy as np

    scene = {k: TensorXf(v.numpy()) for k, v in random_scene(count=20).items()}
    expected = drjit_api.rasterization(**scene, width=8, height=6, packed=True, camera_model="pinhole")[0].numpy()
    same = drjit_api.rasterization(**scene, width=np.int64(8), height=np.int32(6), with_ut=False, rays=None)[0].numpy()
    assert (expected == same).all() and expected.shape == (1, 6, 8, 3)
    with pytest.raises(ValueError, match=r"^with_ut=True is not available"):
        drjit_api.rasterization(**scene, width=8, height=6, with_ut=True)
    with pytest.raises(TypeError, match="'colour'"):
        drjit_api.rasterization(**scene, width=8, height=6, colour=1)
    depth = drjit_api.rasterization(**(scene | {"colors": None}), width=8, height=6, render_mode="D")[0]
    assert depth.shape == (1, 6, 8, 1)
    with pytest.raises(ValueError, match=r"^colors must be a Dr\.Jit tensor"):
        drjit_api.rasterization(**(scene | {"colors": None}), width=8, height=6)
    from drjit.scalar import TensorXf as Scalar

    with pytest.raises(ValueError, match=r"^means must be .* not drjit\.scalar"):
        drjit_api.rasterization(**(scene | {"means": Scalar([0.0] * 60, (20, 3))}), width=8, height=6)


def tensors(scene: dict[str, torch.Tensor]) -> dict[str, Any]:
    return {name: TensorXf(value.contiguous().numpy()) for name, value in scene.items()}


@pytest.mark.parametrize(
    ("harmonics", "each_camera"), [("none", False), ("none", True), ("own", False), ("own", True), ("shared", False)]
)
def test_batches_and_colors_of_each_camera_are_those_through_torch(harmonics: str, each_camera: bool) -> None:
    single = [random_scene(count=40, width=20, height=16, cameras=2, seed=seed) for seed in range(2)]
    batch = {name: torch.stack([scene[name] for scene in single])[None] for name in single[0]}
    options: dict[str, Any] = {"width": 20, "height": 16, "render_mode": "RGB+ED"}
    random = torch.Generator().manual_seed(3)
    if harmonics != "none":
        options["sh_degree"] = 1
        shape = (40, 4, 3) if harmonics == "shared" else (1, 2, *(2,) * each_camera, 40, 4, 3)
        batch["colors"] = 0.3 * torch.randn(shape, generator=random)
    elif each_camera:
        batch["colors"] = torch.rand(1, 2, 2, 40, 3, generator=random)
    leaves = {name: value.clone().requires_grad_() for name, value in batch.items()}
    expected, coverage, _ = rasterization(**leaves, **options)
    given = tensors(batch)
    dr.enable_grad(list(given.values()))
    image, alpha = drjit_api.rasterization(**given, **options)
    assert image.shape == tuple(expected.shape) == (1, 2, 2, 16, 20, 4) and alpha.shape == tuple(coverage.shape)
    assert abs(image.numpy() - expected.detach().numpy()).max() < 1e-5
    weight = torch.randn(expected.shape, generator=random)
    (expected * weight).sum().backward()
    dr.backward(dr.sum(image * TensorXf(weight.numpy())))
    for name, leaf in leaves.items():
        got = torch.from_numpy(dr.grad(given[name]).numpy().copy())
        assert leaf.grad is not None and float((got - leaf.grad).norm()) <= 1e-5 * float(leaf.grad.norm()), name


def test_one_type_of_float32_tensors_for_all() -> None:
    from drjit.llvm import TensorXf as Plain
    from drjit.llvm.ad import TensorXf64

    scene = tensors(random_scene(count=20))
    with pytest.raises(ValueError, match=r"^scales must hold float32 numbers"):
        drjit_api.rasterization(**(scene | {"scales": TensorXf64(scene["scales"])}), width=8, height=8)
    with pytest.raises(ValueError, match=r"^colors is a drjit\.llvm\.TensorXf, but means is a drjit\.llvm\.ad"):
        drjit_api.rasterization(**(scene | {"colors": Plain(scene["colors"].numpy())}), width=8, height=8)


def test_bad_batches_are_named_as_through_torch() -> None:
    scene = random_scene(count=20)
    batch = {name: value[None] for name, value in scene.items()}
    cases: list[tuple[dict[str, torch.Tensor], dict[str, Any], str]] = [
        (batch | {"quats": scene["quats"]}, {}, r"^quats must have the shape \[1, N, 4\]"),
        (batch | {"backgrounds": batch["backgrounds"][..., :2]}, {}, r"^backgrounds must have the shape \[1, C, D\]"),
        ({name: value[:0] for name, value in batch.items()}, {}, r"^means must have batch dimensions of at least 1"),
        (batch | {"colors": batch["colors"][..., None, :]}, {"sh_degree": 1}, r"^colors has 1 harmonics a channel"),
        (scene | {"radial_coeffs": torch.zeros(1, 4)}, {}, "^radial_coeffs is for fisheye lenses"),
        (scene | {"viewmats": scene["viewmats"][:0], "Ks": scene["Ks"][:0]}, {}, "."),
    ]
    for arguments, options, message in cases:
        with pytest.raises(ValueError, match=message):
            rasterization(**arguments, width=8, height=8, **options)
        with pytest.raises(ValueError, match=message):
            drjit_api.rasterization(**tensors(arguments), width=8, height=8, **options)
    lens = TensorXf([0.0] * 4, (1, 4))
    dr.enable_grad(lens)
    with pytest.raises(ValueError, match="radial_coeffs gets no gradient"):
        drjit_api.rasterization(**tensors(scene), width=8, height=8, radial_coeffs=lens, camera_model="fisheye")


def test_a_frozen_function_is_told_where_to_end_and_works_around_the_call() -> None:
    @dr.freeze
    def whole(scene: dict[str, Any]) -> Any:
        return drjit_api.rasterization(**scene, width=16, height=16)[0]

    with pytest.raises(RuntimeError) as refused:
        whole(tensors(random_scene(count=20)))
    assert "cannot be recorded by drjit.freeze" in str(refused.value.__cause__)

    @dr.freeze
    def before(means: Any, shift: Any) -> Any:
        return means + shift

    @dr.freeze
    def after(image: Any) -> Any:
        return dr.sum(image * image)

    for seed in range(3):
        scene = tensors(random_scene(count=20 + seed, seed=seed))
        shift = TensorXf([0.01 * seed], (1, 1))
        image = drjit_api.rasterization(**(scene | {"means": before(scene["means"], shift)}), width=16, height=16)[0]
        plain = drjit_api.rasterization(**(scene | {"means": scene["means"] + shift}), width=16, height=16)[0]
        assert (image.numpy() == plain.numpy()).all()
        assert after(image).numpy() == pytest.approx((plain.numpy() ** 2).sum(), rel=1e-5)


def test_no_camera_loses_its_gradient() -> None:
    """Several threads once lost one in five of them, where Dr.Jit chose how to add up what comes from slices."""
    single = [random_scene(count=40, width=20, height=16, cameras=2, seed=seed) for seed in range(2)]
    scene = {name: torch.stack([part[name] for part in single]) for name in single[0]}
    scene["colors"] = 0.3 * torch.randn(40, 4, 3, generator=torch.Generator().manual_seed(1))
    first: dict[str, Any] = {}
    for _ in range(15):
        given = tensors(scene)
        dr.enable_grad(list(given.values()))
        image, _ = drjit_api.rasterization(**given, width=20, height=16, sh_degree=1, render_mode="RGB+ED")
        dr.backward(dr.sum(image * image))
        found = {name: dr.grad(tensor).numpy().copy() for name, tensor in given.items()}
        first = first or found
        for name, gradient in found.items():
            assert abs(gradient - first[name]).max() <= 1e-4 * abs(first[name]).max(), name
