"""Orthographic and fisheye cameras against the oracle, gsplat's projections and OpenCV's lens model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from drjit_splat import prepare, rasterization, reference
from drjit_splat.llvm import require

from .common import assert_close, compare, one_splat, random_scene, render_with_gradients

LENS = torch.tensor([[0.06, -0.02, 0.008, -0.001]])


def ortho_scene(**sizes: Any) -> dict[str, Tensor]:
    scene = random_scene(**sizes)
    scene["Ks"] = torch.tensor([[[30.0, 0, 29], [0, 28.0, 33], [0, 0, 1]]]).repeat(len(scene["viewmats"]), 1, 1)
    return scene


def wide_scene(count: int = 300, seed: int = 0) -> dict[str, Tensor]:
    """Splats in all directions up to 85 degrees off the axis of a fisheye lens."""
    scene = random_scene(count=count, seed=seed)
    g = torch.Generator().manual_seed(seed + 50)
    theta = math.radians(85) * torch.rand(count, generator=g)
    phi = 2 * math.pi * torch.rand(count, generator=g)
    far = 1 + torch.rand(count, generator=g)
    direction = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    scene["means"] = direction * far[:, None]
    scene["viewmats"] = torch.eye(4)[None]
    scene["Ks"] = torch.tensor([[[20.0, 0, 31], [0, 21.0, 33], [0, 0, 1]]])
    return scene


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_ortho_is_the_oracles(mode: str) -> None:
    scene = ortho_scene(count=200)
    assert_close(compare(scene, 64, 64, camera_model="ortho", rasterize_mode=mode, render_mode="RGB+D"))


@pytest.mark.parametrize("lens", [None, LENS])
def test_fisheye_is_the_oracles(lens: Tensor | None) -> None:
    options: dict[str, Any] = {} if lens is None else {"radial_coeffs": lens}
    found = compare(wide_scene(), 64, 64, camera_model="fisheye", render_mode="RGB+D", **options)
    assert_close(found, gradient=1e-4)
    assert found.meta["n_visible"][0] > 150


def test_ortho_sees_no_depth() -> None:
    near, far = (one_splat(means=[[0.1, 0.0, z]]) for z in (1.0, 7.0))
    images = [rasterization(**scene, width=16, height=16, camera_model="ortho")[0] for scene in (near, far)]
    assert torch.equal(*images) and images[0].sum() > 1


def test_a_splat_on_the_axis_of_a_fisheye_is_the_pinholes() -> None:
    scene = one_splat(scales=[[0.05, 0.02, 0.03]], quats=[[1.0, 0.3, -0.2, 0.4]])
    pinhole, wanted, _ = render_with_gradients(scene, 16, 16)
    fisheye, found, _ = render_with_gradients(scene, 16, 16, camera_model="fisheye")
    assert float((pinhole - fisheye).abs().max()) < 1e-6
    for name in ("quats", "scales", "opacities", "colors"):
        assert torch.allclose(found[name], wanted[name], rtol=1e-4, atol=1e-5), name
    assert all(torch.isfinite(g).all() for g in found.values())


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_projections_are_gsplats(model: str) -> None:
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="skipped: gsplat is not installed")
    scene = wide_scene() if model == "fisheye" else ortho_scene(count=200)
    meta = rasterization(**scene, width=64, height=64, packed=False, camera_model=model)[2]
    quats = torch.nn.functional.normalize(scene["quats"], dim=-1).double()
    covars, _ = gsplat._quat_scale_to_covar_preci(quats, scene["scales"].double(), True, False)
    _, means2d, depths, conics, _ = gsplat._fully_fused_projection(
        scene["means"].double(), covars, scene["viewmats"].double(), scene["Ks"].double(), 64, 64, camera_model=model
    )
    seen = meta["visible"]
    assert int(seen.sum()) > 100
    assert torch.allclose(meta["means2d"][seen].double(), means2d[seen], atol=1e-3)
    assert torch.allclose(meta["depths"][seen].double(), depths[seen], atol=1e-5)
    assert torch.allclose(meta["conics"][seen].double(), conics[seen], rtol=1e-3, atol=1e-5)


def test_the_lens_is_opencvs() -> None:
    cv2 = pytest.importorskip("cv2", reason="skipped: opencv is not installed")
    scene = wide_scene()
    meta = rasterization(**scene, width=64, height=64, packed=False, camera_model="fisheye", radial_coeffs=LENS)[2]
    seen = meta["visible"][0]
    points = scene["means"][seen].double().numpy()[None]
    K, lens = scene["Ks"][0].double().numpy(), LENS[0].double().numpy()
    pixels, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, lens)
    assert np.abs(pixels[0] - meta["means2d"][0][seen].numpy()).max() < 1e-3


def test_a_lens_that_folds_back_shows_nothing_beyond() -> None:
    folding = torch.tensor([[-0.3, 0.0, 0.0, 0.0]])  # turns at theta^2 = 1 / 0.9, which is 60 degrees
    scene = wide_scene()
    arguments = {"width": 64, "height": 64, "camera_model": "fisheye", "radial_coeffs": folding}
    meta = rasterization(**scene, **arguments, packed=False)[2]
    theta = torch.atan2(scene["means"][:, :2].norm(dim=-1), scene["means"][:, 2])
    assert meta["visible"][0].any() and not meta["visible"][0][theta > 1.06].any()
    expected = reference.rasterization(**scene, **arguments)[2]["visible"]
    assert torch.equal(meta["visible"], expected)


def test_cameras_and_batches_have_lenses_of_their_own() -> None:
    scene = wide_scene(count=60)
    lenses = torch.cat([LENS, torch.zeros_like(LENS)])
    two = scene | {
        name: scene[name].repeat(2, *[1] * (scene[name].ndim - 1)) for name in ("viewmats", "Ks", "backgrounds")
    }
    arguments: dict[str, Any] = {"width": 32, "height": 32, "camera_model": "fisheye"}
    image = rasterization(**two, **arguments, radial_coeffs=lenses)[0]
    for i, lens in enumerate((LENS, None)):
        assert float((image[i] - rasterization(**scene, **arguments, radial_coeffs=lens)[0][0]).abs().max()) < 1e-5
    batch = {name: torch.stack([value, value]) for name, value in scene.items()}
    assert torch.equal(rasterization(**batch, **arguments, radial_coeffs=lenses[:, None])[0][:, 0], image)
    prepared = prepare(
        *(two[k] for k in ("means", "quats", "scales", "opacities", "viewmats", "Ks")),
        32,
        32,
        camera_model="fisheye",
        radial_coeffs=lenses,
    )
    assert torch.equal(prepared.shade(two["colors"], backgrounds=two["backgrounds"])[0], image)


def test_what_a_camera_model_cannot_have_is_refused() -> None:
    scene = one_splat()
    for changes, named in (
        ({"camera_model": "fisheye", "semantics": "inria"}, "camera_model"),
        ({"camera_model": "fisheye", "radial_coeffs": torch.zeros(1, 6)}, "radial_coeffs"),
        ({"camera_model": "fisheye", "radial_coeffs": torch.zeros(1, 4).requires_grad_()}, "radial_coeffs"),
        ({"camera_model": "ortho", "radial_coeffs": torch.zeros(1, 4)}, "radial_coeffs"),
        ({"camera_model": "fisheye", "radial_coeffs": torch.full((1, 4), torch.nan)}, r"radial_coeffs\[0, 0\]"),
    ):
        with pytest.raises(ValueError, match=named):
            rasterization(**scene, width=16, height=16, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_the_drjit_interface_has_them_too(model: str) -> None:
    require()
    from drjit.llvm.ad import TensorXf

    from drjit_splat import drjit_api

    scene = wide_scene(count=60) if model == "fisheye" else ortho_scene(count=60)
    lens = LENS if model == "fisheye" else None
    expected = rasterization(**scene, width=32, height=32, camera_model=model, radial_coeffs=lens)[0]
    tensors = {k: TensorXf(v.numpy()) for k, v in scene.items()}
    radial = None if lens is None else TensorXf(lens.numpy())
    image = drjit_api.rasterization(**tensors, width=32, height=32, camera_model=model, radial_coeffs=radial)[0]
    assert np.abs(image.numpy() - expected.numpy()).max() < 1e-6
