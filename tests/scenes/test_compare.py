import numpy as np
import pytest
import torch

import scenes
from drjit_splat import rasterization
from scenes import compare_splats
from uika.head import HeadModel, HeadParameters, look_at, pose_gaussians, pose_vertices, surface_points, uv_texels


def reference() -> dict[str, np.ndarray]:
    mask = np.zeros((10, 10), np.float32)
    mask[2:8, 2:8] = 1
    return {"mask": mask, "depth": mask * 0.8}


def test_equal_images_agree_perfectly() -> None:
    images = reference()
    report = compare_splats(torch.from_numpy(images["mask"])[..., None], images["depth"], images)
    assert (report.mask_iou, report.depth_median, report.pixels) == (1.0, 0.0, 36)


def test_offsets_are_measured() -> None:
    images = reference()
    shifted = np.roll(images["mask"], 1, axis=1)
    report = compare_splats(shifted, images["depth"] + 0.002, images)
    assert report.mask_iou == pytest.approx(30 / 42)
    assert report.depth_median == pytest.approx(0.002, abs=1e-6)
    assert report.pixels == 30


def test_disjoint_images_have_no_depth() -> None:
    images = reference()
    report = compare_splats(1 - images["mask"], images["depth"], images)
    assert report.mask_iou == 0 and np.isnan(report.depth_median)


def test_mismatch_is_named() -> None:
    with pytest.raises(ValueError, match="lacks \\['depth'\\]"):
        compare_splats(np.ones((2, 2)), np.ones((2, 2)), {"mask": np.ones((2, 2))})
    with pytest.raises(ValueError, match="alpha has shape"):
        compare_splats(np.ones((2, 3)), np.ones((2, 2)), {"mask": np.ones((2, 2)), "depth": np.ones((2, 2))})


def test_posed_splats_agree_with_mitsuba(head: HeadModel) -> None:
    binding = uv_texels(head, 256)
    params = HeadParameters.zeros(head).replace(
        rotation=torch.tensor([0.1, 0.3, 0.0]), jaw=torch.tensor([0.2, 0.0, 0.0])
    )
    posed = pose_vertices(head, params)
    M = len(binding)
    means, quats, sizes = pose_gaussians(
        surface_points(head.template, head.faces, binding),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(M, 4),
        torch.full((M, 3), 0.0012),
        head.template,
        posed,
        head.faces,
        binding.triangle,
        binding.barycentric,
    )
    camera = look_at(yaw=20, distance=0.8, size=192)
    opacities, colors = torch.full((M,), 0.9), torch.ones(M, 3)
    image, alpha, _ = rasterization(
        means, quats, sizes, opacities, colors, camera.viewmat[None], camera.K[None], 192, 192, render_mode="RGB+ED"
    )
    reference = scenes.render(posed, head, camera, aovs=("mask", "depth"))
    report = compare_splats(alpha[0], image[0, ..., 3], reference)
    assert report.mask_iou > 0.9
    assert report.depth_median < 0.0025
    moved = scenes.render(posed + torch.tensor([0.01, 0.0, 0.01]), head, camera, aovs=("mask", "depth"))
    worse = compare_splats(alpha[0], image[0, ..., 3], moved)
    assert worse.mask_iou < report.mask_iou and worse.depth_median > 0.005
