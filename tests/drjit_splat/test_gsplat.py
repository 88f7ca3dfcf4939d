"""Arguments, order and images of gsplat's function."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from drjit_splat import rasterization, reference
from drjit_splat._inputs import finish
from drjit_splat._settings import Settings

from .common import one_splat, random_scene


def gsplats_images(gsplat: Any, scene: dict[str, Tensor], meta: dict[str, Any], settings: Settings) -> list[Tensor]:
    """Images [C, H, W, D], coverage and trusted pixels from gsplat's projection and harmonics, blended by the oracle.

    The scene has no batch dimensions; meta (not packed) decides the depth order and what is visible.
    """
    n, size = len(scene["means"]), (settings.width, settings.height)
    quats = torch.nn.functional.normalize(scene["quats"], dim=-1)
    covars, _ = gsplat._quat_scale_to_covar_preci(quats, scene["scales"], True, False)
    _, means2d, depths, conics, _ = gsplat._fully_fused_projection(
        scene["means"], covars, scene["viewmats"], scene["Ks"], *size
    )
    everywhere = torch.tensor([[0.0, size[0]], [0.0, size[1]]], dtype=torch.float64).expand(n, 2, 2)
    found = []
    for i, view in enumerate(scene["viewmats"]):
        shared = 2 if settings.sh_degree is None else 3
        seen = scene["colors"] if scene["colors"].ndim == shared else scene["colors"][i]
        if settings.sh_degree is not None:
            directions = scene["means"] - torch.linalg.inv(view)[:3, 3]
            seen = (gsplat._spherical_harmonics(settings.sh_degree, directions, seen) + 0.5).clamp_min(0)
        a, b, d = conics[i].double().unbind(-1)
        determinant = 1 / (a * d - b * b)
        projection = reference.Projection(
            means2d[i].double(),
            depths[i].double(),
            torch.stack([d, -b, a], -1) * determinant[:, None],
            determinant,
            scene["opacities"].double(),
            drawable=meta["visible"][i],
            visible=meta["visible"][i],
            margin=torch.ones(n, dtype=torch.float64),
            radii=meta["radii"][i],
            span=everywhere,
        )
        features = [seen.double()] if settings.has_colors else []
        features += [depths[i].double()[:, None]] if settings.has_depth else []
        order = torch.argsort(meta["depths"][i], stable=True)
        sums, coverage, _, margin = reference.blend(projection, torch.cat(features, -1), settings, order, None)
        background = scene["backgrounds"][i].double() if "backgrounds" in scene else None
        found.append((finish(sums, coverage, background, settings), coverage, (margin > 1e-3)[..., None]))
    return [torch.stack(parts) for parts in zip(*found, strict=True)]


def test_images_from_gsplats_projection_and_harmonics() -> None:
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="skipped: gsplat is not installed")
    scene = random_scene(cameras=2)
    scene["colors"] = 0.3 * torch.randn(500, 16, 3, generator=torch.Generator().manual_seed(1))
    options = {"sh_degree": 3, "render_mode": "RGB+ED"}
    colors, alphas, meta = rasterization(
        **scene, width=64, height=48, packed=False, absgrad=False, tile_size=16, **options
    )
    wanted, coverage, trusted = gsplats_images(gsplat, scene, meta, Settings.of(64, 48, **options))
    assert float(trusted.double().mean()) > 0.5
    assert float(((colors - wanted).abs() * trusted)[..., :3].max()) < 1e-4
    assert float(((alphas - coverage).abs() * trusted).max()) < 1e-4
    covered = trusted & (coverage > 0.05)
    assert float(((colors - wanted).abs() * covered)[..., 3:].max()) < 1e-4 * 3


@pytest.mark.slow
@pytest.mark.parametrize("per_view_color", [True, False])
@pytest.mark.parametrize("sh_degree", [None, 3])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+D", "D"])
@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
def test_every_combination_that_gsplat_tests(
    per_view_color: bool, sh_degree: int | None, render_mode: str, packed: bool, batch: tuple[int, ...]
) -> None:
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="skipped: gsplat is not installed")
    g = torch.Generator().manual_seed(42)
    n, cameras, width, height = 300, 3, 60, 40
    single = []
    for _ in range(math.prod(batch)):
        colors = (*(cameras,) * per_view_color, n, *(() if sh_degree is None else (16,)), 3)
        scene = {
            "means": torch.rand(n, 3, generator=g),
            "quats": torch.randn(n, 4, generator=g),
            "scales": torch.rand(n, 3, generator=g),
            "opacities": torch.rand(n, generator=g),
            "colors": torch.rand(colors, generator=g),
            "viewmats": torch.eye(4).expand(cameras, 4, 4),
            "Ks": torch.tensor([[60.0, 0, 30], [0, 60, 20], [0, 0, 1]]).expand(cameras, 3, 3),
        }
        single.append(scene)
    together = {k: torch.stack([s[k] for s in single]).view(*batch, *single[0][k].shape) for k in single[0]}
    options = {"sh_degree": sh_degree, "render_mode": render_mode}
    image, alpha, _ = rasterization(**together, width=width, height=height, packed=packed, **options)
    channels = {"RGB": 3, "RGB+D": 4, "D": 1}[render_mode]
    assert image.shape == (*batch, cameras, height, width, channels)
    images, alphas = image.view(-1, *image.shape[-4:]), alpha.view(-1, *alpha.shape[-4:])
    for b, scene in enumerate(single):
        meta = rasterization(**scene, width=width, height=height, packed=False, **options)[2]
        wanted, coverage, trusted = gsplats_images(gsplat, scene, meta, Settings.of(width, height, **options))
        assert float(trusted.double().mean()) > 0.5
        assert float(((images[b] - wanted).abs() * trusted).max()) < 1e-4
        assert float(((alphas[b] - coverage).abs() * trusted).max()) < 1e-4


@pytest.mark.parametrize(
    "arguments",
    [
        {"packed": True, "tile_size": 16, "channel_chunk": 32, "segmented": False},
        {"sparse_grad": False, "absgrad": False, "distributed": False, "camera_model": "pinhole"},
        {"with_ut": False, "with_eval3d": False, "radial_coeffs": None, "viewmats_rs": None},
        {"return_normals": False, "global_z_order": True, "rays": None, "lidar_coeffs": None, "ut_params": None},
        {"external_distortion_coeffs": None, "extra_signals": None, "extra_signals_sh_degree": None},
        {"renderer_config": None, "tile_size": None, "absgrad": True, "sparse_grad": True},
    ],
)
def test_arguments_that_change_no_pixel_are_accepted(arguments: dict[str, object]) -> None:
    scene = one_splat()
    expected = rasterization(**scene, width=16, height=16)[0]
    assert torch.equal(rasterization(**scene, width=16, height=16, **arguments)[0], expected)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("distributed", True),
        ("with_ut", True),
        ("with_eval3d", True),
        ("tangential_coeffs", torch.zeros(1, 2)),
        ("rolling_shutter", "ROLLING_TOP_TO_BOTTOM"),
        ("lidar_coeffs", object()),
        ("rays", torch.zeros(1, 16, 16, 6)),
        ("return_normals", True),
    ],
)
def test_arguments_that_ask_for_more_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"^{name}="):
        rasterization(**one_splat(), width=16, height=16, **{name: value})


def test_unknown_arguments_are_an_error() -> None:
    with pytest.raises(TypeError, match="'colour'"):
        rasterization(**one_splat(), width=16, height=16, colour=1)


def test_surfels_are_refused_when_they_are_called() -> None:
    from drjit_splat import rasterization_2dgs

    with pytest.raises(NotImplementedError, match="rasterization_2dgs is not available: 2D Gaussians"):
        rasterization_2dgs(**one_splat(), width=16, height=16)
