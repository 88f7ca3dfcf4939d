"""The loop: resuming, skipping, overfitting, several processes, and a model that can be used."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.train.common import ALONE, CONFIG, PaintedPeople, PaintedPerson, losses, run
from uika.errors import UikaError
from uika.model import load_checkpoint
from uika.reconstruction import check_model
from uika.train import MODEL_FILE, TrainingError, load_estimator
from uika.train.checkpoint import Checkpoints
from uika.train.logbook import SKIPPED

pytestmark = pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")
ROOT = Path(__file__).parents[2]


def test_a_resumed_run_goes_on_as_if_nothing_had_happened(tmp_path):
    whole = run(tmp_path / "whole")
    # The same schedule, stopped half way by taking the later checkpoint away.
    run(tmp_path / "cut")
    folder = tmp_path / "cut" / "checkpoints"
    newest = folder / "step-00000004"
    part = next(newest.glob("*.safetensors"))
    part.write_bytes(part.read_bytes()[:1000])
    resumed = run(tmp_path / "cut", resume=True)
    # Splat gradients are summed in an order that differs between threads and runs, by about 1e-7.
    assert losses(resumed) == pytest.approx(losses(whole), rel=1e-5)
    assert len(resumed) == 4


def test_a_damaged_checkpoint_is_passed_over(tmp_path, capsys):
    run(tmp_path)
    (tmp_path / "checkpoints" / "step-00000004" / "progress.json").write_text("{")
    latest = Checkpoints(tmp_path / "checkpoints", 2, ALONE).latest()
    assert latest is not None and latest.name == "step-00000002"
    assert "step-00000004" in capsys.readouterr().err


def test_runs_are_not_overwritten_or_mixed(tmp_path):
    run(tmp_path, replace(CONFIG, steps=1))
    with pytest.raises(UikaError, match="--resume"):
        run(tmp_path)
    with pytest.raises(UikaError, match="learning_rate"):
        run(tmp_path, replace(CONFIG, learning_rate=1e-3), resume=True)


class SpoiledPeople(PaintedPeople):
    """The second of three has a picture that is not finite."""

    def __getitem__(self, index):
        return PaintedPerson(index, spoiled=index == 1)


class OnlySpoiled(PaintedPeople):
    def __getitem__(self, index):
        return PaintedPerson(index, spoiled=True)


def test_a_step_that_is_not_finite_is_skipped_and_named(tmp_path):
    config = replace(CONFIG, part="estimator", sources=1, images=1, items=1, steps=3)
    log = run(tmp_path, config, SpoiledPeople())
    assert len(log) == 2 and all(torch.isfinite(torch.tensor(losses(log))))
    (line,) = (tmp_path / SKIPPED).read_text().splitlines()
    assert json.loads(line)["images"][0].startswith("001_")
    model = load_estimator(tmp_path / MODEL_FILE)
    assert all(bool(torch.isfinite(p).all()) for p in model.parameters())


def test_a_training_that_has_gone_astray_stops(tmp_path):
    config = replace(CONFIG, part="estimator", sources=1, images=1, items=1, steps=9, patience=3)
    with pytest.raises(TrainingError, match="3 steps in a row"):
        run(tmp_path, config, OnlySpoiled())


def test_overfitting_lowers_the_loss_and_the_model_can_be_used(tmp_path):
    config = replace(CONFIG, steps=25, warmup=3, learning_rate=3e-3, ema=0.0, save_every=25)
    log = run(tmp_path, config, overfit=1)
    # The untrained surface is near the pictures already: what is left to learn in 25 steps is a tenth of the loss.
    assert losses(log)[-1] < 0.92 * losses(log)[0]
    check_model(tmp_path / MODEL_FILE)
    kept, wanted = load_checkpoint(tmp_path / MODEL_FILE).config, config.finished
    assert (kept.map_size, kept.detail) == (wanted.map_size, wanted.detail)
    assert kept.gaussians == replace(config.model.gaussians, least_scale=wanted.gaussians.least_scale)
    assert set(log[0]) >= {"seconds_data", "seconds_network", "seconds_splat", "seconds_splat_backward"}


def test_the_estimator_learns(tmp_path):
    config = replace(CONFIG, part="estimator", steps=12, warmup=2, learning_rate=1e-3, ema=0.0, save_every=12)
    log = run(tmp_path, config, overfit=1)
    assert log[-1]["error"] < 0.8 * log[0]["error"]
    maps = load_estimator(tmp_path / MODEL_FILE)(torch.rand(1, 1, 3, 64, 64))
    assert maps.shape == (1, 1, 2, 64, 64)


def test_workers_make_the_same_items(tmp_path):
    config = replace(CONFIG, steps=2)
    assert losses(run(tmp_path / "a", config)) == losses(run(tmp_path / "b", config, workers=1))


def test_gradient_checkpointing_changes_no_loss(tmp_path):
    plain = losses(run(tmp_path / "a", replace(CONFIG, steps=2)))
    again = losses(run(tmp_path / "b", replace(CONFIG, steps=2, checkpointing=True)))
    assert again == pytest.approx(plain, rel=1e-5)


_TWO = """
import sys
from dataclasses import replace
from pathlib import Path
from tests.train.common import CONFIG, run
from uika.train import join_group, leave_group
group = join_group("cpu")
config = replace(CONFIG, sources=1, images=1, items=1, steps=3)
run(Path(sys.argv[1]), config, group=group, sharding=sys.argv[2])
if len(sys.argv) > 3:
    run(Path(sys.argv[1]), replace(config, steps=4), group=group, sharding=sys.argv[2], resume=True)
leave_group()
"""


@pytest.mark.slow
@pytest.mark.parametrize("sharding", ["ddp", "fsdp"])
def test_two_processes_train_like_one(tmp_path, sharding):
    alone = run(tmp_path / "alone", replace(CONFIG, sources=1, images=2, items=2, steps=3))
    script = tmp_path / "two.py"
    script.write_text(_TWO)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, str(tmp_path / "two"), sharding], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [json.loads(line) for line in (tmp_path / "two" / "log.jsonl").read_text().splitlines()]
    assert losses(lines) == pytest.approx(losses(alone), rel=1e-4)
    assert load_checkpoint(tmp_path / "two" / MODEL_FILE).config == CONFIG.model


def test_a_training_config_names_what_cannot_work():
    with pytest.raises(UikaError, match="size"):
        replace(CONFIG, size=50)
    with pytest.raises(UikaError, match="preset"):
        replace(CONFIG, preset="huge")


def test_the_command_refuses_before_it_works(tmp_path, capsys):
    from uika.cli import main

    assert main(["train", "-o", str(tmp_path / "run"), "--data", str(tmp_path / "none")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert main(["train", "-o", str(tmp_path / "run"), "--data", "synthetic", "x"]) == 2
    assert "not both" in capsys.readouterr().err
