"""The gate on a folder of photos."""

import json
import shutil
from pathlib import Path

import pytest

from tools.real_gate import main, means, people, read, verdict
from uika.assets import PORTRAIT
from uika.errors import UikaError

BEFORE = {"a": {"head": 20.0, "face": 30.0, "iou": 0.95}, "b": {"head": 24.0, "face": 28.0, "iou": 0.97}}


def test_means_that_fall_behind_and_people_newly_refused_close_the_gate() -> None:
    assert means(BEFORE) == pytest.approx({"head": 22.0, "face": 29.0, "iou": 0.96})
    assert verdict(BEFORE, BEFORE) == []
    worse = {"a": {"head": 21.0, "face": 29.0, "iou": 0.95}, "b": {"head": 24.0, "face": 28.0, "iou": 0.97}}
    assert verdict(worse, BEFORE) == ["face: the mean of 2 people went from 29.000 to 28.500"]
    assert verdict({**BEFORE, "b": {}}, BEFORE) == ["b: is refused and was not"]
    better = {"a": {"landmarks": 1.0}}
    assert verdict(better, {"a": {"landmarks": 1.5}}) == []
    assert len(verdict({"a": {"landmarks": 1.5}}, better)) == 1


def test_people_are_named_by_what_their_photos_hold(tmp_path: Path) -> None:
    (tmp_path / "somebody").mkdir()
    shutil.copy(PORTRAIT, tmp_path / "one.jpg")
    shutil.copy(PORTRAIT, tmp_path / "somebody" / "two.jpg")
    (tmp_path / "notes.txt").write_text("no photo")
    found = people(tmp_path)
    assert [path.name for photos in found.values() for path in photos] in (["one.jpg"], ["two.jpg"])
    assert all(len(name) == 8 for name in found)
    with pytest.raises(UikaError, match="no such folder"):
        people(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UikaError, match="holds no photos"):
        people(tmp_path / "empty")


def test_a_file_of_another_kind_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "kept.json").write_text("[1]")
    with pytest.raises(UikaError, match=r"kept\.json: cannot be read as figures"):
        read(tmp_path / "kept.json")


@pytest.mark.slow
def test_a_run_keeps_figures_and_compares_with_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photos").mkdir()
    shutil.copy(PORTRAIT, tmp_path / "photos" / "portrait.jpg")
    kept = tmp_path / "figures.json"
    assert main([str(tmp_path / "photos"), "--model", "none", "--output", str(kept)]) == 0
    figures = next(iter(read(kept).values()))
    assert figures["face"] > 25
    assert figures["iou"] > 0.9
    assert "portrait" not in kept.read_text()
    kept.write_text(json.dumps({name: {**row, "face": row["face"] + 1} for name, row in read(kept).items()}))
    assert main([str(tmp_path / "photos"), "--model", "none", "--kept", str(kept)]) == 1
    assert "face: the mean of 1 people" in capsys.readouterr().out
