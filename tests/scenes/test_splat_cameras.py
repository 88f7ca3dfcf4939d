"""Cameras of splats against rays that Mitsuba's sensors cast: each ray meets every Gaussian where it is densest.

Along a ray the densest point of a Gaussian lies at the Mahalanobis distance that its projection along that ray has,
so that an orthographic image of splats must be that of the rays, whatever their size. In perspective and through a
fisheye lens the projection is linearised at each centre, and the two agree the better the smaller the splats are.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from drjit_splat import rasterization
from drjit_splat._rotations import quats_to_rotations
from scenes import load_mitsuba
from scenes.splats import opencv_view

WIDTH, HEIGHT = 60, 44
Rays = tuple[NDArray[np.float64], NDArray[np.float64]]
Model = Literal["pinhole", "ortho", "fisheye"]


def splats(size: float) -> dict[str, torch.Tensor]:
    """Forty splats about the origin, standard deviations up to `size`."""
    g = torch.Generator().manual_seed(4)
    return {
        "means": 1.6 * torch.rand(40, 3, generator=g) - 0.8,
        "quats": torch.randn(40, 4, generator=g),
        "scales": size * (0.3 + 0.7 * torch.rand(40, 3, generator=g)),
        "opacities": 0.3 + 0.6 * torch.rand(40, generator=g),
        "colors": torch.rand(40, 3, generator=g),
    }


def sensor(kind: str) -> Any:
    mi = load_mitsuba()
    T = mi.ScalarTransform4f
    to_world = T().look_at([1.0, 0.7, 3.0], [0.1, -0.1, 0.0], [0, 1, 0])
    wide = {"fov": 40.0, "to_world": to_world}
    own = wide if kind == "perspective" else {"to_world": to_world @ T().scale([1.2, 1.2, 1])}
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    return mi.load_dict({"type": kind, **own, "film": film})


def mitsuba_rays(camera: Any) -> Rays:
    """Origins and directions [H*W,3] of the rays through the middles of the pixels."""
    mi = load_mitsuba()
    y, x = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    film = mi.Point2f(x.ravel().astype(np.float32) / WIDTH, y.ravel().astype(np.float32) / HEIGHT)
    ray, _ = camera.sample_ray(0.0, 0.0, film, mi.Point2f(0.0))
    return np.array(ray.o, dtype=np.float64).T.reshape(-1, 3), np.array(ray.d, dtype=np.float64).T.reshape(-1, 3)


def fisheye_rays(viewmat: torch.Tensor, focal: float) -> Rays:
    """Rays whose angle from the axis is the distance from the image's middle over the focal length."""
    y, x = np.meshgrid(np.arange(HEIGHT) + 0.5 - HEIGHT / 2, np.arange(WIDTH) + 0.5 - WIDTH / 2, indexing="ij")
    radius = np.hypot(x, y)
    theta, phi = radius / focal, np.arctan2(y, x)
    local = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    turn, shift = viewmat[:3, :3].double().numpy(), viewmat[:3, 3].double().numpy()
    return np.broadcast_to(-turn.T @ shift, local.shape), local @ turn


def traced(given: dict[str, torch.Tensor], rays: Rays, viewmat: torch.Tensor) -> tuple[NDArray[Any], NDArray[Any]]:
    """Colours [H,W,3] of the rays, and whether every decision of a pixel [H,W] lies clear of its threshold."""
    means, opacities, colors = (given[name].double().numpy() for name in ("means", "opacities", "colors"))
    turn = quats_to_rotations(torch.nn.functional.normalize(given["quats"].double(), dim=-1)).numpy()
    whitened = np.swapaxes(turn, 1, 2) / given["scales"].double().numpy()[:, :, None]  # [N,3,3] to unit Gaussians
    origins, directions = rays
    depths = means @ viewmat[2, :3].double().numpy() + float(viewmat[2, 3])
    image, left = np.zeros((len(origins), 3)), np.ones((len(origins), 1))
    clear = np.ones(len(origins), dtype=bool)
    for index in np.argsort(depths):
        start = (origins - means[index]) @ whitened[index].T
        along = directions @ whitened[index].T
        nearest = start - along * ((start * along).sum(-1) / (along * along).sum(-1))[:, None]
        alpha = np.minimum(0.999, opacities[index] * np.exp(-0.5 * (nearest**2).sum(-1)))
        clear &= np.abs(alpha * 255 - 1) > 1e-2
        alpha = np.where(alpha < 1 / 255, 0, alpha)[:, None]
        image += left * alpha * colors[index]
        left = left * (1 - alpha)
    return image.reshape(HEIGHT, WIDTH, 3), clear.reshape(HEIGHT, WIDTH)


def differences(
    given: dict[str, torch.Tensor], rays: Rays, viewmat: torch.Tensor, K: torch.Tensor, model: Model
) -> NDArray[Any]:
    """Absolute differences [pixels, 3] between the splats' image and that of the rays."""
    image = rasterization(
        **given, viewmats=viewmat[None], Ks=K[None], width=WIDTH, height=HEIGHT, camera_model=model, eps2d=0.0
    )[0][0]
    wanted, clear = traced(given, rays, viewmat)
    assert wanted.max() > 0.3 and clear.mean() > 0.9
    return np.abs(image.numpy() - wanted)[clear]


@pytest.mark.parametrize("size", [0.05, 0.4])
def test_orthographic_pixels_are_those_of_mitsubas_rays(size: float) -> None:
    camera = sensor("orthographic")
    view = opencv_view(load_mitsuba(), camera)
    assert view.model == "ortho"
    found = differences(splats(size), mitsuba_rays(camera), view.viewmat, view.K, "ortho")
    assert found.max() < 2e-5


@pytest.mark.parametrize(("size", "mean", "most"), [(0.02, 5e-5, 5e-3), (0.1, 3e-3, 0.03)])
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_other_pixels_come_as_near_as_the_linearised_projection_allows(
    model: Model, size: float, mean: float, most: float
) -> None:
    camera = sensor("perspective")
    view = opencv_view(load_mitsuba(), camera)
    rays, K = mitsuba_rays(camera), view.K
    if model == "fisheye":
        focal = 0.5 * WIDTH / math.radians(25)
        K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
        rays = fisheye_rays(view.viewmat, focal)
    found = differences(splats(size), rays, view.viewmat, K, model)
    assert found.mean() < mean and found.max() < most, (found.mean(), found.max())
