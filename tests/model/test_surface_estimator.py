"""The small correspondence estimator and its file."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from uika.assets import CORRESPONDENCE_WEIGHTS
from uika.head import load_head
from uika.model import CheckpointError, Estimator
from uika.model.config import SurfaceEstimatorConfig
from uika.model.estimator_file import check_estimator_head, read_estimator, save_estimator
from uika.model.surface_codes import surface_table
from uika.model.surface_estimator import SurfaceEstimator, chance_within

SMALL = SurfaceEstimatorConfig(size=32, widths=(8, 8), blocks=(1, 1), table=48)


def small() -> SurfaceEstimator:
    torch.manual_seed(0)
    return SurfaceEstimator(SMALL, surface_table(load_head().without_bust, SMALL.table)).eval()


def test_maps_have_the_photos_size_whatever_it_is() -> None:
    model = small()
    for side in (32, 50):
        seen = model.observe(torch.rand(2, 3, 3, side, side))
        assert seen.uv.shape == (2, 3, 2, side, side)
        assert seen.confidence.shape == seen.hair.shape == (2, 3, side, side)
        known = torch.isfinite(seen.uv[:, :, 0])
        assert bool((seen.confidence[~known] == 0).all())
        assert bool((seen.uv[:, :, 0][known] >= 0).all())


def test_views_do_not_depend_on_each_other() -> None:
    model, images = small(), torch.rand(1, 3, 3, 32, 32)
    together, alone = model.observe(images), model.observe(images[:, 1:2])
    assert torch.allclose(together.confidence[:, 1:2], alone.confidence, atol=1e-6)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\[B,V,3,S,S\]"):
        small().observe(torch.rand(1, 1, 3, 32, 40))
    with pytest.raises(ValueError, match="multiple"):
        SurfaceEstimatorConfig(size=36, widths=(8, 8, 8), blocks=(1, 1, 1))


def test_the_chance_is_that_of_the_density() -> None:
    """Errors on a plane that fall off as exp(-e/s), against their histogram."""
    scale = 0.03
    radius = torch.distributions.Gamma(2.0, 1 / scale).sample((200_000,))
    said = chance_within(0.065, torch.tensor(scale).log())
    assert float(said) == pytest.approx(float((radius < 0.065).float().mean()), abs=0.005)


def test_a_file_keeps_the_estimator_to_half_precision(tmp_path: Path) -> None:
    model, path = small(), tmp_path / "small.safetensors"
    save_estimator(path, SMALL, model.state_dict(), {"head": load_head().without_bust.id})
    loaded = read_estimator(path)
    assert isinstance(loaded, SurfaceEstimator) and not isinstance(loaded, Estimator)
    for name, value in model.state_dict().items():
        assert torch.allclose(loaded.state_dict()[name].float(), value.float(), rtol=2e-3, atol=1e-6), name
    images = torch.rand(1, 1, 3, 32, 32)
    assert torch.allclose(loaded.observe(images).confidence, model.observe(images).confidence, atol=0.02)
    check_estimator_head(path, load_head())


def test_damaged_files_are_one_sentence(tmp_path: Path) -> None:
    model, path = small(), tmp_path / "small.safetensors"
    save_estimator(path, SMALL, model.state_dict(), {})
    tensors = load_file(path)
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    del tensors["table_uv"]
    save_file(tensors, path, header)
    with pytest.raises(CheckpointError, match="cannot be read as an estimator"):
        read_estimator(path)


def test_the_built_in_one_is_small_and_of_the_built_in_head() -> None:
    assert CORRESPONDENCE_WEIGHTS.stat().st_size <= 8_000_000
    check_estimator_head(CORRESPONDENCE_WEIGHTS, load_head())
    assert isinstance(read_estimator(CORRESPONDENCE_WEIGHTS), SurfaceEstimator)
