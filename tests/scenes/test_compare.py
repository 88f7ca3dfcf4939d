import numpy as np
import pytest
import torch

from scenes import compare_splats


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
