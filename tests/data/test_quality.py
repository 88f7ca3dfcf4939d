import pytest
import torch

from uika.data import Sample
from uika.data.quality import warping_errors
from uika.head import look_at


def sample(timestep: int, camera: str, yaw: float, colour: float, columns: slice = slice(0, 64)) -> Sample:
    """A wall of one colour; `columns` of the atlas fill the image."""
    v, u = torch.meshgrid((torch.arange(64) + 0.5) / 64, (torch.arange(64) + 0.5) / 64, indexing="ij")
    valid = torch.zeros(64, 64, dtype=torch.bool)
    valid[:, columns] = True
    return Sample(
        key=f"one_{timestep}_{camera}",
        identity="one",
        timestep=timestep,
        camera_id=camera,
        image=torch.full((3, 64, 64), colour),
        mask=torch.ones(64, 64),
        camera=look_at(yaw, size=64),
        uv=torch.stack((u, v), -1),
        uv_valid=valid,
    )


def test_errors_are_mean_squares_of_shared_texels() -> None:
    samples = [sample(t, c, yaw, 0.5 + 0.1 * t + dc) for t in (0, 1) for c, yaw, dc in (("a", 0, 0.0), ("b", 30, 0.2))]
    errors = warping_errors(samples)
    assert errors.spatial == pytest.approx(0.04, rel=1e-4) and errors.spatial_pairs == 2
    assert errors.temporal == pytest.approx(0.01, rel=1e-4) and errors.temporal_pairs == 2


def test_distant_views_and_disjoint_parts_do_not_count() -> None:
    errors = warping_errors([sample(0, "a", 0, 0.1), sample(0, "b", 90, 0.9)])
    assert errors.spatial_pairs == 0
    left, right = sample(0, "a", 0, 0.1, slice(0, 32)), sample(1, "a", 0, 0.9, slice(32, 64))
    assert warping_errors([left, right]).temporal_pairs == 0


def test_unlabelled_samples_are_refused() -> None:
    plain = sample(0, "a", 0, 0.5)
    with pytest.raises(ValueError, match="one_0_a has no correspondences"):
        warping_errors([Sample(plain.key, "one", 0, "a", plain.image, plain.mask, plain.camera)])
