"""Landmarks out of correspondences, and the estimator's place in tracking."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.train.common import CONFIG, PaintedPerson, run
from uika.cli import main
from uika.data.labels import tracked_uv
from uika.data.views import View
from uika.head import load_head, pose_vertices, project
from uika.model.estimator_file import read_estimator
from uika.reconstruction.estimated_landmarks import SIDE, EstimatedLandmarks
from uika.train import MODEL_FILE

pytestmark = pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")


@pytest.fixture(scope="module")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("estimator")
    run(folder, CONFIG.__class__(**{**vars(CONFIG), "part": "estimator", "steps": 1, "sources": 1, "items": 1}))
    return folder / MODEL_FILE


def test_exact_correspondence_gives_the_marks_where_they_are(estimator: Path) -> None:
    head = load_head()
    sample = PaintedPerson(1).sample(0)
    view = View(sample, SIDE)
    assert view.parameters is not None
    uv = tracked_uv(view, head)
    known = torch.isfinite(uv[0])
    found, seen = EstimatedLandmarks(estimator, head).places(torch.nan_to_num(uv), known)
    truth, _ = project(head.landmarks(pose_vertices(head, view.parameters)), view.camera)
    assert float(seen.float().mean()) > 0.7  # the others lie behind or on seams
    assert float((found - truth)[seen].norm(dim=1).median()) < 2.0  # pixels of 512


def test_marks_move_by_no_more_than_is_likely(estimator: Path) -> None:
    """An untrained estimator sees nothing sensible, and marks stay finite and near."""
    place = EstimatedLandmarks(estimator, load_head())
    picture = np.full((300, 300, 3), 128, np.uint8)
    marks = np.random.default_rng(0).uniform(100, 200, (478, 2))
    moved = place(picture, marks)
    assert moved.shape == marks.shape and np.isfinite(moved).all()


def test_only_estimators_of_this_head_are_taken(
    estimator: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path / "model", CONFIG.__class__(**{**vars(CONFIG), "steps": 1, "sources": 1, "items": 1}))
    words = ["track", "none.mp4", "-o", str(tmp_path / "a.npz"), "--estimator"]
    assert main([*words, str(tmp_path / "model" / MODEL_FILE)]) == 2
    assert "is a reconstruction model, not a correspondence estimator" in " ".join(capsys.readouterr().err.split())
    from tests.exports import bare_flame
    from uika.head import save_head

    save_head(bare_flame(), tmp_path / "flame.npz")
    assert main([*words, str(estimator), "--head", str(tmp_path / "flame.npz")]) == 2
    assert f"was trained for the head model '{load_head().without_bust.id}'" in " ".join(
        capsys.readouterr().err.split()
    )
    assert read_estimator(estimator)
