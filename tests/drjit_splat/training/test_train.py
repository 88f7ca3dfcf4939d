"""Runs learn, go on exactly where they were stopped, and stop where they diverge."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from drjit_splat import cli, load_ply
from drjit_splat.training import Progress, TrainConfig, gaussians, open_capture, train
from drjit_splat.training.loop import _strategy, read_log
from drjit_splat.training.processes import Processes
from tests.drjit_splat.training.made_up import write_colmap, write_nerfstudio

QUICK = TrainConfig(steps=90, random_splats=300, max_splats=400, sh_degree=1, checkpoint_every=30)


@pytest.mark.parametrize(("strategy", "steps", "gain"), [("default", 200, 1.0), ("mcmc", 90, 5.0)])
def test_held_out_photos_are_learned(tmp_path: Path, strategy: str, steps: int, gain: float) -> None:
    capture = open_capture(write_colmap(tmp_path / "data", binary=True))
    config = replace(QUICK, strategy=strategy, steps=steps)
    untrained = train(capture, tmp_path / "untrained", replace(config, steps=1))
    figures = train(capture, tmp_path / "run", config)
    assert figures["psnr"] > untrained["psnr"] + gain
    assert set(figures["held_out"]) == {"000.png", "008.png"} and 0.5 < figures["ssim"] <= 1
    found = load_ply(tmp_path / "run" / "splats.ply")
    assert len(found.means) == figures["splats"] <= 400 and found.degree == 1
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text()) == figures
    assert [p.step for p in read_log(tmp_path / "run")][-1] == steps


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_stopped_run_goes_on_with_the_same_losses(tmp_path: Path, strategy: str) -> None:
    capture = open_capture(write_nerfstudio(tmp_path / "data"))
    config = replace(QUICK, strategy=strategy, appearance=True, refine_poses=True, random_background=True)
    whole: list[float] = []
    train(capture, tmp_path / "whole", config, watch=lambda p, _: whole.append(p.loss))

    def stop(progress: Progress, _: object) -> None:
        if progress.step == 47:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(capture, tmp_path / "stopped", config, watch=stop)
    rest: list[Progress] = []
    train(capture, tmp_path / "stopped", config, watch=lambda p, _: rest.append(p))
    assert rest[0].step == 31
    # Sums over threads are not the same to the last bit in two runs of the same program either.
    assert [p.loss for p in rest] == pytest.approx(whole[30:], rel=1e-4)
    with pytest.raises(ValueError, match="other settings"):
        train(capture, tmp_path / "stopped", replace(config, seed=1))


def test_a_run_that_diverges_stops_and_keeps_its_checkpoint(tmp_path: Path) -> None:
    capture = open_capture(write_nerfstudio(tmp_path / "data"))

    def spoil(progress: Progress, params: dict[str, torch.nn.Parameter]) -> None:
        if progress.step == 40:
            params["sh0"].data[:] = 1e38

    with pytest.raises(ValueError, match="no longer finite at step 4"):
        train(capture, tmp_path / "run", QUICK, watch=spoil)
    (tmp_path / "run" / "checkpoint.safetensors").read_bytes()
    assert train(capture, tmp_path / "run", QUICK)["steps"] == 90


def test_the_command_trains_and_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, run = write_nerfstudio(tmp_path / "data"), tmp_path / "run"
    command = ["train", str(data), "-o", str(run), "--steps", "5", "--random-splats", "50", "--no-coarse-to-fine"]
    assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert "10 photos to learn from, 2 held out" in out and "splats.ply: " in out
    (run / "checkpoint.safetensors").write_bytes(b"no checkpoint")
    assert cli.main(command) == 2
    assert "remove it to begin anew" in capsys.readouterr().err
    assert cli.main(["train", str(tmp_path / "nothing"), "-o", str(tmp_path / "other")]) == 2
    assert "nothing: no such data set" in capsys.readouterr().err and not (tmp_path / "other").exists()
    assert cli.main([*command, "--steps", "0"]) == 2
    assert "steps must lie between" in capsys.readouterr().err


def test_random_starts_lie_where_most_cameras_look(tmp_path: Path) -> None:
    capture = open_capture(write_nerfstudio(tmp_path))
    means = gaussians.start(capture, replace(QUICK, random_splats=200))["means"].detach()
    assert means.shape == (200, 3)
    seen = torch.zeros(200)
    for photo in capture.photos:
        points = means @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3]
        pixels = points @ photo.K.T
        seen += ((pixels[:, :2] / pixels[:, 2:] - 24).abs().amax(-1) < 24) & (points[:, 2] > 0)
    assert float(seen.min()) >= 0.7 * float(seen.max()) - 1e-3 and float(seen.max()) == len(capture.photos)


def test_growth_fills_the_room_with_the_most_pulled_and_no_more() -> None:
    count = 50
    params = gaussians_at_random(count)
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
    strategy = _strategy(replace(QUICK, max_splats=60), Processes())
    pulled = torch.linspace(0, 1, count)
    state = {"grad2d": pulled.clone(), "count": torch.ones(count), "scene_scale": 1e6}
    before = params["means"].detach().clone()
    assert strategy._grow(params, optimizers, state, 100) == (10, 0)  # type: ignore[union-attr]
    assert torch.equal(params["means"].detach(), torch.cat([before, before[pulled > pulled[39]]]))
    assert strategy.grow_grad2d == 0.0002  # type: ignore[union-attr]
    assert strategy._grow(params, optimizers, state, 100) == (0, 0)  # type: ignore[union-attr]


def gaussians_at_random(count: int) -> dict[str, torch.nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    sizes = {"means": (count, 3), "scales": (count, 3), "quats": (count, 4), "opacities": (count,)}
    return {name: torch.nn.Parameter(torch.randn(size, generator=generator)) for name, size in sizes.items()}
