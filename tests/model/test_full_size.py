"""The released model at its own size, with random weights: needs 5 GB of disk, 8 GB of memory and minutes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.model.released_files import VALID, write_full
from uika.model import ESTIMATORS, PRESETS, Estimator, Reconstructor

GIB = 2**30


@pytest.mark.slow
def test_full_size_file_runs_from_one_photo_to_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "uika.safetensors"
    write_full(path)
    size = path.stat().st_size / GIB
    assert 4.4 < size < 4.6
    command = [sys.executable, "-m", "tests.model.full_size", str(path), "bfloat16"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    print({name: value for name, value in figures.items() if name != "sample"})
    assert figures["gaussians"] == VALID
    assert figures["finite"]
    assert figures["spread"] > 1e-3
    assert figures["peak_gib"] <= size + 2


def test_parameter_counts_of_the_released_model() -> None:
    import torch

    with torch.device("meta"):
        network, estimator = Reconstructor(PRESETS["paper"]), Estimator(ESTIMATORS["paper"])

    def count(module: torch.nn.Module) -> int:
        return sum(parameter.numel() for parameter in module.parameters())

    # The file also holds what nothing reads: queries in both attentions of the last block, and a mask token each.
    assert count(network.transformer) + 2 * (1024 * 1024 + 1024 + 64) == 505_872_384
    assert count(network.gs_decoder) == 31_325_727
    assert count(network.encoder.fusion_head) == 8_393_728
    assert count(network.encoder.model) + 1024 == 303_154_176
    assert count(estimator) + 768 == 173_598_723
