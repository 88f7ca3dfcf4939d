"""Losses against recorded values of the released code and by their own meaning."""

import pytest
import torch
from safetensors.torch import load_file

from tests.recorded import PARITY, recorded
from uika.metrics.structural_similarity import ssim_map
from uika.train.losses import gradient_loss, l1, offset_loss, opacity_entropy, ssim_loss, variation


@recorded
def test_losses_match_the_released_ones():
    data = load_file(PARITY / "losses.safetensors")
    image, reference = data["in/pred"], data["in/gt"]
    values = {
        "l1": l1(image, reference),
        "offset_reg": offset_loss(data["in/offset"]),
        "opacity_entropy": opacity_entropy(data["in/opacity"]),
    }
    for name, value in values.items():
        torch.testing.assert_close(value, data[f"out/{name}"], rtol=0, atol=1e-6)


@recorded
def test_ssim_matches_the_kernel_arithmetic():
    data = load_file(PARITY / "ssim_derived.safetensors")
    result = ssim_map(data["in/a"].double(), data["in/b"].double())
    torch.testing.assert_close(result, data["out/ssim_map"].double(), rtol=0, atol=1e-6)
    assert float(ssim_loss(data["in/a"], data["in/b"])) == pytest.approx(1 - float(data["out/ssim"]), abs=1e-5)


def test_ssim_refuses_shapes_that_differ():
    with pytest.raises(ValueError, match="one shape"):
        ssim_map(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 9))


def test_offsets_of_either_sign_are_drawn_back():
    offsets = torch.tensor([[-0.02, 0.01, 0.0]], requires_grad=True)
    offset_loss(offsets).backward()
    assert offsets.grad is not None
    assert (offsets.grad.sign() == offsets.detach().sign()).all()


def test_gradients_tell_blur_that_l1_forgives():
    picture = (torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0)) > 0.5).float()
    grey = torch.full_like(picture, 0.5)
    shifted = picture + 0.5  # the same mean error, but every edge in place
    assert float(l1(grey, picture)) == pytest.approx(float(l1(shifted, picture)))
    assert float(gradient_loss(shifted, picture)) < 1e-6 < 0.1 < float(gradient_loss(grey, picture))


def test_entropy_is_least_for_decided_opacities():
    assert float(opacity_entropy(torch.tensor([0.0, 1.0]))) < 2e-5
    assert float(opacity_entropy(torch.tensor([0.5]))) == pytest.approx(0.6931, abs=1e-4)


def test_variation_is_least_for_even_maps():
    ramp = torch.linspace(0, 1, 5).expand(1, 1, 4, 5)
    assert float(variation(ramp)) == pytest.approx(1 / 16)
    assert float(variation(torch.full((1, 2, 4, 4), 0.3))) == 0
