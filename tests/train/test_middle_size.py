"""`uika train --preset base` in two processes with a made-up backbone: it starts, says what it uses, and goes on."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.exports import write_export, write_flame
from tests.train.test_requirements import backbone_file
from uika.model import PRESETS

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_two_processes_train_the_middle_size(tmp_path: Path) -> None:
    backbone = backbone_file(tmp_path / "dinov3_vits16.safetensors", PRESETS["base"].backbone)
    flame = write_flame(tmp_path / "flame.npz")
    data = write_export(tmp_path / "data" / "306_EMO-1_v16", cameras=3).parent
    run = tmp_path / "run"
    start = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "uika"]
    words = ["train", "--preset", "base", "--data", str(data), "--head", str(flame), "-o", str(run)]
    words += ["--size", "128", "--images", "1", "--workers", "0", "--device", "cpu"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def train(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*start, *words, *more], env=environment, capture_output=True, text=True, cwd=ROOT)

    refused = train("--steps", "1")
    assert "preset 'base' needs the weights of DINOv3 ViT-S/16" in refused.stderr
    assert not (run / "log.jsonl").exists()
    done = train("--steps", "1", "--backbone", str(backbone))
    assert done.returncode == 0, done.stderr[-3000:]
    said = done.stdout + done.stderr
    print(said)
    assert f"backbone: {backbone} (sha256 " in said and "21.6 M frozen" in said
    again = train("--steps", "2", "--resume")
    assert again.returncode == 0, again.stderr[-3000:]
    assert "resumed: " in again.stdout + again.stderr
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    print(lines)
    assert [line["step"] for line in lines] == [0, 1] and all(line["heads"] == 2 for line in lines)
