"""The example programs fit a picture."""

from __future__ import annotations

from pathlib import Path

import pytest

from uika.assets import PORTRAIT

pytest.importorskip("PIL", reason="skipped: pillow is not installed")

from drjit_splat import load_ply
from drjit_splat.training import open_capture
from examples import fit_image_drjit, fit_image_network, fit_image_torch, fit_image_wrapped, train_scene
from tests.drjit_splat.training.made_up import write_colmap


def test_fit_with_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    errors = fit_image_torch.fit(PORTRAIT, count=600, steps=25, size=64, report=0)
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fitted.png").stat().st_size > 1000
    assert len(load_ply(tmp_path / "fitted.ply").means) == 600


def test_fit_with_drjit_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    errors = fit_image_drjit.fit(PORTRAIT, count=600, steps=25, size=64, report=0)
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fitted.png").stat().st_size > 1000


def test_fit_with_a_drjit_function_in_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    errors = fit_image_wrapped.fit(fit_image_wrapped.PORTRAIT, count=600, steps=25, size=64, report=0)
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fitted.png").stat().st_size > 1000


def test_fit_with_a_network_in_drjit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    errors = fit_image_network.fit(fit_image_network.PORTRAIT, count=600, steps=25, size=64, report=0)
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fitted.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_scene_is_trained_alike_by_gsplats_strategy_and_by_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("gsplat", reason="skipped: gsplat is not installed")
    monkeypatch.chdir(tmp_path)
    capture = open_capture(write_colmap(tmp_path / "data", binary=True))
    found = {name: train_scene.train(capture, name, steps=160, count=300) for name in ("gsplat", "own")}
    assert found["gsplat"]["splats"] == found["own"]["splats"] > 320
    assert found["gsplat"]["psnr"] == pytest.approx(found["own"]["psnr"], abs=0.01)
    untrained = train_scene.train(capture, steps=1, count=300)
    assert found["own"]["psnr"] > untrained["psnr"] + 1
    assert len(load_ply("scene.ply").means) == untrained["splats"]
