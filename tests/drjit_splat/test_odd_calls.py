"""Unusual but legal calls against the oracle, and what the types and layouts of the arguments must not change."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from drjit_splat import rasterization

from .common import NAMES, assert_close, compare, one_splat, random_scene

SIZE = {"width": 30, "height": 20}


def harmonics(count: int, coefficients: int, channels: int = 3) -> Tensor:
    return 0.3 * torch.randn(count, coefficients, channels, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("channels", [1, 2, 4, 5, 8, 9, 32, 33])
def test_channels(channels: int) -> None:
    assert_close(compare(random_scene(count=50, channels=channels, cameras=2, **SIZE), **SIZE))


@pytest.mark.parametrize(
    "options",
    [
        {"radius_clip": 3.0},
        {"eps2d": 0.0},
        {"eps2d": 2.0, "rasterize_mode": "antialiased"},
        {"near_plane": 1.9, "far_plane": 2.1},
        {"near_plane": 0.0},
        {"tile_size": 8, "render_mode": "ED"},
        {"tile_size": 32, "render_mode": "D"},
        {"sh_degree": 1},
        {"sh_degree": 0, "render_mode": "RGB+ED"},
        {"rasterize_mode": "antialiased", "render_mode": "RGB+D", "radius_clip": 2.0},
    ],
    ids=str,
)
def test_options(options: dict[str, Any]) -> None:
    scene = random_scene(count=60, cameras=2, **SIZE)
    if "sh_degree" in options:
        scene["colors"] = harmonics(60, 16)
    given = dict(options)
    tile = given.pop("tile_size", None)
    found = compare(scene, **SIZE, **given)
    assert_close(found, gradient=1e-4)
    if tile is not None:
        images = [rasterization(**scene, **SIZE, **given, tile_size=t)[0] for t in (16, tile)]
        assert torch.equal(*images)


def test_unused_harmonics_get_zero_gradients() -> None:
    scene = random_scene(count=50, **SIZE)
    scene["colors"] = harmonics(50, 16).requires_grad_()
    rasterization(**scene, **SIZE, sh_degree=1)[0].sum().backward()
    gradient = scene["colors"].grad
    assert gradient is not None and gradient[:, :4].abs().sum() > 0 and not gradient[:, 4:].any()


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("options", [{}, {"render_mode": "RGB+ED"}, {"sh_degree": 1}, {"absgrad": True}], ids=str)
def test_no_splats_at_all(packed: bool, options: dict[str, Any]) -> None:
    scene = {k: v[:0] if k in NAMES[:5] else v for k, v in random_scene(count=1, cameras=2, **SIZE).items()}
    if "sh_degree" in options:
        scene["colors"] = torch.zeros(0, 4, 3)
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    image, alpha, meta = rasterization(**leaves, **SIZE, packed=packed, **options)
    assert torch.equal(image[..., :3], scene["backgrounds"][:, None, None].expand(2, 20, 30, 3)) and not alpha.any()
    image.sum().backward()
    assert leaves["backgrounds"].grad is not None and float(leaves["backgrounds"].grad.min()) == 600
    assert leaves["means"].grad is None or leaves["means"].grad.shape == (0, 3)
    assert meta["means2d"].shape == ((0, 2) if packed else (2, 0, 2)) and len(meta["flatten_ids"]) == 0
    assert meta["isect_offsets"].shape == (2, 2, 2)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (5, 3)])
def test_one_splat_in_small_images(size: tuple[int, int]) -> None:
    scene = one_splat(Ks=[[[20.0, 0.0, size[0] / 2], [0.0, 20.0, size[1] / 2], [0.0, 0.0, 1.0]]])
    assert_close(compare(scene, *size, render_mode="RGB+D"))


def test_splats_at_the_edge_of_what_is_allowed() -> None:
    scene = random_scene(count=40, **SIZE)
    scene["opacities"][:6] = torch.tensor([0.0, 1.0, 1 / 255, 0.999, 1e-30, 0.5])
    scene["quats"][6] = torch.tensor([0.0, 3.0, 0.0, 0.0])
    scene["quats"][7] *= 1e4
    scene["scales"][8] = torch.tensor([1e-6, 0.1, 1e-6])
    scene["means"][9] = torch.tensor([0.0, 0.0, -50.0])
    assert_close(compare(scene, **SIZE), gradient=1e-4)
    scene["quats"][10], scene["scales"][11] = 0.0, 0.0
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    image = rasterization(**leaves, **SIZE)[0]
    image.sum().backward()
    assert image.isfinite().all() and all(leaf.grad.isfinite().all() for leaf in leaves.values())  # type: ignore[union-attr]


@pytest.mark.parametrize("packed", [True, False])
def test_absolute_gradients_of_packed_calls_and_batches(packed: bool) -> None:
    scene = random_scene(count=40, cameras=2, **SIZE)
    scene["means"][::3] += 100

    def absolute(batched: bool, packed: bool) -> tuple[Tensor, Tensor, Any]:
        given = {k: (v[None] if batched else v).clone().requires_grad_() for k, v in scene.items()}
        image, _, meta = rasterization(**given, **SIZE, absgrad=True, packed=packed)
        meta["means2d"].retain_grad()
        image.square().sum().backward()
        return meta["means2d"].absgrad, meta["means2d"].grad, meta

    wanted, gradient, meta = absolute(False, False)
    found, signed, own = absolute(True, packed)
    if packed:
        rows = own["camera_ids"], own["gaussian_ids"]
        assert not own["batch_ids"].any() and torch.equal(meta["visible"].nonzero(), torch.stack(rows, -1))
        wanted, gradient = wanted[rows], gradient[rows]
    else:
        wanted, gradient = wanted[None], gradient[None]
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(signed, gradient, rtol=1e-4, atol=1e-5)
    assert bool((found + 1e-5 >= signed.abs()).all())


@pytest.mark.parametrize("asked", NAMES)
def test_one_gradient_alone_is_that_among_all(asked: str) -> None:
    scene = random_scene(count=40, cameras=2, **SIZE)
    everything = {k: v.clone().requires_grad_() for k, v in scene.items()}
    rasterization(**everything, **SIZE, render_mode="RGB+D")[0].square().sum().backward()
    alone = scene | {asked: scene[asked].clone().requires_grad_()}
    rasterization(**alone, **SIZE, render_mode="RGB+D")[0].square().sum().backward()
    wanted = everything[asked].grad
    assert wanted is not None and alone[asked].grad is not None
    torch.testing.assert_close(alone[asked].grad, wanted, rtol=1e-4, atol=1e-5 * float(wanted.abs().max()))


def test_layouts_change_nothing() -> None:
    scene = random_scene(count=40, cameras=3, **SIZE)
    for name in ("viewmats", "Ks", "backgrounds"):
        scene[name] = scene[name][:1].expand(3, *scene[name].shape[1:])
    expected = {k: v.contiguous().clone().requires_grad_() for k, v in scene.items()}
    image = rasterization(**expected, **SIZE)[0]
    image.square().sum().backward()
    strided = {
        "means": torch.zeros(40, 6)[:, ::2].copy_(scene["means"]),
        "quats": torch.zeros(4, 40).T.copy_(scene["quats"]),
        "scales": torch.zeros(80, 3)[::2].copy_(scene["scales"]),
        "opacities": torch.zeros(40, 2)[:, 1].copy_(scene["opacities"]),
        "colors": torch.zeros(3, 40).T.copy_(scene["colors"]),
    }
    leaves = {k: v.requires_grad_() for k, v in strided.items()}
    cameras = {k: v.detach().clone()[:1].requires_grad_() for k, v in scene.items() if k not in strided}
    found = rasterization(**leaves, **{k: v.expand(3, *v.shape[1:]) for k, v in cameras.items()}, **SIZE)[0]
    assert torch.equal(found, image)
    found.square().sum().backward()
    for name, leaf in (leaves | cameras).items():
        wanted = expected[name].grad
        assert wanted is not None and leaf.grad is not None
        wanted = wanted.sum(0, keepdim=True) if name in cameras else wanted
        torch.testing.assert_close(leaf.grad, wanted, rtol=1e-4, atol=1e-5 * float(wanted.abs().max()))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_the_callers_type_comes_back(dtype: torch.dtype) -> None:
    scene = {k: v.to(dtype) for k, v in random_scene(count=40, cameras=2, **SIZE).items()}
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    image, alpha, _ = rasterization(**leaves, **SIZE, render_mode="RGB+ED")
    assert image.dtype == alpha.dtype == dtype
    single = {k: v.float().requires_grad_() for k, v in scene.items()}
    wanted = rasterization(**single, **SIZE, render_mode="RGB+ED")[0]
    assert torch.equal(image, wanted.to(dtype))
    image.sum().backward()
    wanted.sum().backward()
    for name, leaf in leaves.items():
        expected = single[name].grad
        assert leaf.grad is not None and expected is not None and leaf.grad.dtype == dtype, name
        scale = float(expected.abs().max())
        assert float((leaf.grad.float() - expected).abs().max()) <= 1e-2 * scale, name


def test_types_may_differ_between_arguments() -> None:
    scene = random_scene(count=40, **SIZE)
    mixed = scene | {name: scene[name].double() for name in ("viewmats", "Ks", "opacities")}
    assert torch.equal(rasterization(**mixed, **SIZE)[0], rasterization(**scene, **SIZE)[0])


def test_nothing_is_kept_without_gradients() -> None:
    scene = {k: v.requires_grad_() for k, v in random_scene(count=40, **SIZE).items()}
    with torch.no_grad():
        image, _, meta = rasterization(**scene, **SIZE)
        assert not image.requires_grad and not meta["means2d"].requires_grad
    with torch.inference_mode():
        assert torch.equal(rasterization(**scene, **SIZE)[0], image)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"viewmats": 0, "Ks": 0}, "viewmats must hold at least one camera"),
        ({"means": "batch"}, r"^quats must have the shape \[2, N, 4\]"),
        ({"viewmats": "batch"}, r"^viewmats must have the shape \[C, 4, 4\]"),
        ({"backgrounds": "batch"}, r"^backgrounds must have the shape"),
        ({"opacities": "batch"}, r"^opacities must have the shape \[N\]"),
    ],
    ids=str,
)
def test_batch_dimensions_of_some_arguments_only(changes: dict[str, Any], message: str) -> None:
    scene = random_scene(count=10, **SIZE)
    for name, change in changes.items():
        scene[name] = scene[name][:0] if change == 0 else scene[name].expand(2, *scene[name].shape)
    if changes.keys() == {"viewmats", "Ks"}:
        scene["backgrounds"] = scene["backgrounds"][:0]
    with pytest.raises(ValueError, match=message):
        rasterization(**scene, **SIZE)
