"""The example programs fit a picture."""

from __future__ import annotations

from pathlib import Path

import pytest

from uika.assets import PORTRAIT

pytest.importorskip("PIL", reason="skipped: pillow is not installed")

from drjit_splat import load_ply
from examples import fit_image_drjit, fit_image_network, fit_image_torch, fit_image_wrapped


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
