from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.metrics.lpips_files import random_weights, write_weights
from uika.errors import UikaError
from uika.metrics.lpips import Lpips


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Lpips:
    return Lpips(write_weights(tmp_path_factory.mktemp("lpips") / "weights.safetensors"))


def test_distance_rises_with_noise_and_is_symmetric(network: Lpips) -> None:
    random = torch.Generator().manual_seed(1)
    image, noise = torch.rand(1, 3, 48, 48, generator=random), torch.randn(1, 3, 48, 48, generator=random)
    assert float(network(image, image)) == 0.0
    found = [float(network(image, image + amount * noise)) for amount in (0.02, 0.1, 0.4)]
    assert found == sorted(found) and found[0] > 0
    assert float(network(image + 0.1 * noise, image)) == pytest.approx(found[1], rel=1e-4)


def test_the_first_stage_is_as_published(tmp_path: Path) -> None:
    """With a single stage's gain left, the distance is that of unit features, written out here."""
    weights = random_weights()
    for stage in range(1, 5):
        weights[f"lin{stage}.weight"].zero_()
    save_file(weights, tmp_path / "first.safetensors")
    image, other = torch.rand(2, 1, 3, 16, 16, generator=torch.Generator().manual_seed(2))

    def features(picture: torch.Tensor) -> torch.Tensor:
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = ((2 * picture - 1).permute(0, 2, 3, 1) - shift) / scale
        for number in (0, 2):
            patches = torch.nn.functional.unfold(x.permute(0, 3, 1, 2), 3, padding=1)
            x = (weights[f"features.{number}.weight"].flatten(1) @ patches).relu().mT.reshape(1, 16, 16, -1)
        return x / x.norm(dim=-1, keepdim=True)

    gain = weights["lin0.weight"].flatten()
    expected = float(((features(image) - features(other)).square() @ gain).mean())
    network = Lpips(tmp_path / "first.safetensors")
    assert float(network(image, other)) == pytest.approx(expected, rel=1e-4)


def test_files_without_the_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UikaError, match=r"none\.safetensors: cannot be read as LPIPS"):
        Lpips(tmp_path / "none.safetensors")
    (tmp_path / "torn.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0{")
    with pytest.raises(UikaError, match=r"torn\.safetensors: cannot be read as LPIPS"):
        Lpips(tmp_path / "torn.safetensors")
    file = write_weights(tmp_path / "short.safetensors", leave_out="lin3.weight")
    with pytest.raises(UikaError, match=r"lacks the LPIPS tensor 'lin3.weight'"):
        Lpips(file)
