"""Runs as they are started: by two processes of torchrun, and killed in the middle."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from drjit_splat.training import TrainConfig, open_capture
from drjit_splat.training.loop import _Run, read_log
from drjit_splat.training.processes import Processes
from tests.drjit_splat.training.made_up import write_colmap, write_nerfstudio

ROOT = Path(__file__).resolve().parents[3]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
SHORT = ["--steps", "150", "--random-splats", "300", "--max-splats", "500", "--checkpoint-every", "30"]

CHILD = """
import sys
from safetensors.torch import save_file
from drjit_splat.training import TrainConfig, open_capture
from drjit_splat.training.loop import _Run
from drjit_splat.training.processes import joined
from tests.drjit_splat.training.test_processes import CONFIG
with joined() as processes:
    run = _Run(open_capture(sys.argv[1]), CONFIG, None, processes)
    start = run._photo()
    run.advance(0.0)
    save_file({k: v.detach().contiguous() for k, v in run.params.items()}, f"{sys.argv[2]}/first_{processes.rank}")
    for _ in range(60):
        run.advance(0.0)
    save_file({k: v.detach().contiguous() for k, v in run.params.items()}, f"{sys.argv[2]}/last_{processes.rank}")
    print("photo", start, flush=True)
"""
CONFIG = TrainConfig(steps=90, max_splats=500, sh_degree=1, coarse_to_fine=False, random_background=True)


def run(words: list[str], folder: Path) -> str:
    done = subprocess.run(words, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


class _Averaged(Processes):
    """A single process that learns from the photos of two."""

    def average(self, tensors: object) -> None:
        """Nothing: the test adds up itself."""


@pytest.mark.slow
def test_two_processes_hold_the_same_splats_and_learn_from_two_photos(tmp_path: Path) -> None:
    data = write_colmap(tmp_path / "data", binary=True)
    (tmp_path / "child.py").write_text(CHILD)
    said = run([*TORCHRUN, "child.py", str(data), str(tmp_path)], tmp_path)
    assert len({line for line in said.splitlines() if line.startswith("photo")}) == 2
    for moment in ("first", "last"):
        one, other = (load_file(tmp_path / f"{moment}_{rank}") for rank in range(2))
        assert all(torch.equal(one[name], other[name]) for name in one)
    # The first step follows the mean of both photos' gradients.
    gradients = []
    for rank in range(2):
        alone = _Run(open_capture(data), CONFIG, None, _Averaged(rank, 2))
        alone._update = lambda *_: None  # type: ignore[method-assign]
        alone.advance(0.0)
        gradients.append(alone.params["opacities"].grad)
    mean = (gradients[0] + gradients[1]) / 2  # type: ignore[operator]
    moved = load_file(tmp_path / "first_0")["opacities"] - alone.params["opacities"].detach()
    clear = mean.abs() > 1e-3 * mean.abs().max()
    assert torch.equal(moved[clear].sign(), -mean[clear].sign()) and int(clear.sum()) > 20


@pytest.mark.slow
def test_the_command_runs_under_torchrun(tmp_path: Path) -> None:
    data = write_colmap(tmp_path / "data", binary=True)
    command = [*TORCHRUN, "-m", "drjit_splat.cli", "train", str(data), "-o", "run", *SHORT]
    said = run(command, tmp_path)
    assert said.count("held out: PSNR") == 1 and said.count("photos to learn from") == 1
    assert [progress.step for progress in read_log(tmp_path / "run")] == [50, 100, 150]
    assert (tmp_path / "run" / "splats.ply").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_a_killed_run_goes_on_with_the_same_losses(tmp_path: Path, several: bool) -> None:
    data = write_nerfstudio(tmp_path / "data")
    program = [*TORCHRUN, "-m", "drjit_splat.cli"] if several else [sys.executable, "-m", "drjit_splat.cli"]
    command = [*program, "train", str(data), *SHORT, "--strategy", "mcmc"]
    run([*command, "-o", "whole"], tmp_path)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    with subprocess.Popen([*command, "-o", "killed"], cwd=tmp_path, env=ENVIRONMENT, **quiet) as process:  # type: ignore[call-overload]
        log, deadline = tmp_path / "killed" / "log.jsonl", time.monotonic() + 300
        while not log.is_file() and time.monotonic() < deadline:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    reached = len(list(read_log(tmp_path / "killed")))
    assert 1 <= reached < 3 and not (tmp_path / "killed" / "splats.ply").exists()
    run([*command, "-o", "killed"], tmp_path)
    whole, killed = (list(read_log(tmp_path / name)) for name in ("whole", "killed"))
    losses = {progress.step: progress.loss for progress in killed}
    assert [losses[p.step] for p in whole] == pytest.approx([p.loss for p in whole], rel=1e-3)
    assert not [path for path in (tmp_path / "killed").iterdir() if path.name.startswith(".")]
