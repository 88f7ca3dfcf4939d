"""A program written for gsplat runs with only its import changed."""

from __future__ import annotations

import pytest
import torch

from drjit_splat import rasterization, reference
from drjit_splat._inputs import finish
from drjit_splat._settings import Settings

from .common import one_splat, random_scene


def test_images_from_gsplats_projection_and_harmonics() -> None:
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="skipped: gsplat is not installed")
    scene = random_scene(cameras=2)
    scene["quats"] = torch.nn.functional.normalize(scene["quats"], dim=-1)
    scene["colors"] = 0.3 * torch.randn(500, 16, 3, generator=torch.Generator().manual_seed(1))
    colors, alphas, meta = rasterization(
        scene["means"],
        scene["quats"],
        scene["scales"],
        scene["opacities"],
        scene["colors"],
        scene["viewmats"],
        scene["Ks"],
        64,
        48,
        sh_degree=3,
        packed=False,
        absgrad=False,
        tile_size=16,
        backgrounds=scene["backgrounds"],
        render_mode="RGB+ED",
    )
    covars, _ = gsplat._quat_scale_to_covar_preci(scene["quats"], scene["scales"], True, False)
    _, means2d, depths, conics, _ = gsplat._fully_fused_projection(
        scene["means"], covars, scene["viewmats"], scene["Ks"], 64, 48
    )
    settings = Settings(64, 48, render_mode="RGB+ED")
    for i, view in enumerate(scene["viewmats"]):
        directions = scene["means"] - torch.linalg.inv(view)[:3, 3]
        seen = (gsplat._spherical_harmonics(3, directions, scene["colors"]) + 0.5).clamp_min(0)
        a, b, d = conics[i].double().unbind(-1)
        determinant = 1 / (a * d - b * b)
        everywhere = torch.tensor([[0.0, 64.0], [0.0, 48.0]], dtype=torch.float64).expand(500, 2, 2)
        projection = reference.Projection(
            means2d[i].double(),
            depths[i].double(),
            torch.stack([d, -b, a], -1) * determinant[:, None],
            determinant,
            scene["opacities"].double(),
            drawable=meta["visible"][i],
            visible=meta["visible"][i],
            margin=torch.ones(500, dtype=torch.float64),
            radii=meta["radii"][i],
            span=everywhere,
        )
        features = torch.cat([seen.double(), depths[i].double()[:, None]], -1)
        order = torch.argsort(meta["depths"][i], stable=True)
        sums, coverage, _, margin = reference.blend(projection, features, settings, order, None)
        wanted = finish(sums, coverage, scene["backgrounds"][i].double(), settings)
        trusted = (margin > 1e-3)[..., None]
        assert float(trusted.double().mean()) > 0.5
        assert float(((colors[i] - wanted).abs() * trusted)[..., :3].max()) < 1e-4
        assert float(((alphas[i] - coverage).abs() * trusted).max()) < 1e-4
        covered = trusted & (coverage > 0.05)
        assert float(((colors[i] - wanted).abs() * covered)[..., 3:].max()) < 1e-4 * 3


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
