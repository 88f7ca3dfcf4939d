import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage import data
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from uika.metrics import flip, flip_map, psnr, ssim

PHOTO = data.astronaut()[:96, 150:230].astype(np.float32) / 255
DARKER = (PHOTO * 0.7).astype(np.float32)
CHANGED = {
    "shifted": np.roll(PHOTO, 2, axis=1),
    "noisy": np.clip(PHOTO + np.random.default_rng(0).normal(0, 0.1, PHOTO.shape), 0, 1).astype(np.float32),
    "blurred": gaussian_filter(PHOTO, (2, 2, 0)),
    "darker": DARKER,
    "black": np.zeros_like(PHOTO),
}
COLOURS = {"black": (0.0, 0, 0), "white": (1.0, 1, 1), "green": (0.0, 1, 0), "blue": (0.0, 0, 1)}


def tensors(name: str) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(CHANGED[name]), torch.from_numpy(PHOTO)


def plain(name: str) -> torch.Tensor:
    return torch.tensor(COLOURS[name]).expand(40, 40, 3)


@pytest.mark.parametrize("name", CHANGED)
def test_scikit_image_agrees(name: str) -> None:
    first, second = CHANGED[name].astype(np.float64), PHOTO.astype(np.float64)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "channel_axis": 2}
    assert psnr(*tensors(name)) == pytest.approx(peak_signal_noise_ratio(second, first, data_range=1.0), abs=1e-6)
    expected = structural_similarity(first, second, data_range=1.0, **options)
    assert ssim(*tensors(name)) == pytest.approx(expected, abs=1e-9)


def test_equal_pictures_have_no_error() -> None:
    photo = torch.from_numpy(PHOTO)
    assert psnr(photo, photo) == pytest.approx(120.0)
    assert ssim(photo, photo) == pytest.approx(1.0, abs=1e-12)
    assert flip(photo, photo) == 0.0


def test_only_the_mask_counts() -> None:
    photo = torch.from_numpy(PHOTO)
    mask = torch.zeros(photo.shape[:2], dtype=torch.bool)
    mask[:30, :30] = True
    spoiled = photo.clone()
    spoiled[60:, 60:] = 1 - spoiled[60:, 60:]
    assert psnr(spoiled, photo, mask) == pytest.approx(120.0)
    assert ssim(spoiled, photo, mask) == pytest.approx(1.0)
    assert flip(spoiled, photo, mask) == 0.0
    assert psnr(spoiled, photo, ~mask) < psnr(spoiled, photo) < 30
    assert ssim(spoiled, photo, ~mask) < ssim(spoiled, photo) < 0.95
    assert flip(spoiled, photo, ~mask) > flip(spoiled, photo) > 0.01


def test_flip_of_the_farthest_colours_is_one() -> None:
    """Green and blue lie farthest apart, by the definition of the scale."""
    assert flip(plain("green"), plain("blue")) == pytest.approx(1.0, abs=1e-9)
    assert 0.9 < flip(plain("black"), plain("white")) < 1.0


@pytest.mark.parametrize("name", CHANGED)
def test_flip_is_symmetric_and_bounded(name: str) -> None:
    changed, photo = tensors(name)
    error = flip_map(changed, photo)
    assert error.shape == photo.shape[:2]
    assert 0 <= float(error.min()) <= float(error.max()) <= 1
    torch.testing.assert_close(error, flip_map(photo, changed), atol=1e-12, rtol=0)


def test_flip_rises_with_noise_and_falls_with_distance() -> None:
    photo = torch.from_numpy(PHOTO)
    noise = torch.randn(photo.shape, generator=torch.Generator().manual_seed(0))
    errors = [flip((photo + amount * noise).clamp(0, 1), photo) for amount in (0.01, 0.03, 0.1, 0.3)]
    assert errors == sorted(errors) and errors[0] > 0.005
    near, far = (flip((photo + 0.1 * noise).clamp(0, 1), photo, pixels_per_degree=each) for each in (30.0, 120.0))
    assert far < near


@pytest.mark.parametrize("name", CHANGED)
def test_the_authors_program_agrees(name: str) -> None:
    evaluator = pytest.importorskip("flip_evaluator", reason="pip install flip-evaluator to compare with")
    expected, mean, _ = evaluator.evaluate(PHOTO, CHANGED[name], "LDR", applyMagma=False)
    changed, photo = tensors(name)
    assert flip(changed, photo) == pytest.approx(mean, abs=1e-4)
    np.testing.assert_allclose(flip_map(changed, photo), np.squeeze(expected), atol=1e-4)


@pytest.mark.parametrize("metric", [psnr, ssim, flip])
def test_pictures_that_do_not_fit_are_refused(metric) -> None:  # type: ignore[no-untyped-def]
    photo = torch.from_numpy(PHOTO)
    with pytest.raises(ValueError, match="one shape"):
        metric(photo, photo[:50])
    with pytest.raises(ValueError, match="mask: no pixel"):
        metric(photo, photo, torch.zeros(photo.shape[:2], dtype=torch.bool))
    with pytest.raises(ValueError, match="more than 10 pixels"):
        ssim(photo[:10], photo[:10])
    with pytest.raises(ValueError, match=r"\[H,W,3\]"):
        flip(photo[..., :1], photo[..., :1])
