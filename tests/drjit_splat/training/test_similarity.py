"""Structural similarity against scikit-image, and its written-out derivative against autograd's."""

import pytest
import torch

from drjit_splat.training.similarity import psnr, ssim


def images(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(2)
    first = torch.rand(23, 31, 3, generator=random, dtype=dtype)
    return first, (first + 0.2 * torch.randn(23, 31, 3, generator=random, dtype=dtype)).clamp(0, 1)


def test_they_are_scikit_images() -> None:
    metrics = pytest.importorskip("skimage.metrics", reason="skipped: scikit-image is not installed")
    # In a black frame it makes no difference that scikit-image mirrors at the border.
    framed = [torch.nn.functional.pad(image, (0, 0, 11, 11, 11, 11)) for image in images(torch.float64)]
    given = [image.numpy() for image in framed]
    options = {"channel_axis": -1, "data_range": 1, "gaussian_weights": True, "use_sample_covariance": False}
    _, everywhere = metrics.structural_similarity(*given, **options, full=True)
    assert float(ssim(*framed)) == pytest.approx(everywhere.mean(), abs=1e-9)
    assert psnr(*framed) == pytest.approx(metrics.peak_signal_noise_ratio(*given, data_range=1), abs=1e-9)


def test_its_derivative_is_that_of_finite_differences() -> None:
    first, second = images(torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim(x, second[:6, :7]), first[:6, :7].clone().requires_grad_())
    assert float(ssim(first, first)) == pytest.approx(1)
