"""The user study: a page that tells nothing about methods, answers, and their table."""

import csv
import json
import re
from pathlib import Path

import pytest
from PIL import Image

from tests.chromium import page
from uika.cli import main
from uika.errors import UikaError
from uika.evaluate.study import COLUMNS, KEY, PAGE, QUESTIONS, TABLE, read_answers, write_study, write_table

METHODS = ("ours", "tiny-network", "without aggregation")


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    folder = tmp_path / "clips"
    for number, method in enumerate((*METHODS, "reference")):
        (folder / method).mkdir(parents=True)
        for clip in ("anna", "bert"):
            Image.new("RGB", (8, 8), (60 * number, 20, len(clip))).save(folder / method / f"{clip}.png")
    return folder


def answer(path: Path, key: Path, name: str, score: dict[str, int]) -> Path:
    rows = [
        (name, "01", token, question, score[entry["method"]])
        for token, entry in json.loads(key.read_text()).items()
        for question in QUESTIONS
    ]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    return path


def test_the_page_does_not_tell_the_methods(clips: Path, tmp_path: Path) -> None:
    written, key = write_study(clips, tmp_path / "study")
    text = written.read_text()
    assert not any(method in text for method in METHODS) and "anna" not in text
    entries = json.loads(key.read_text())
    assert len(entries) == 6 and {entry["method"] for entry in entries.values()} == set(METHODS)
    assert text.count("data:image/png;base64,") == 6 + 2
    assert not re.search(r"https?://", text)
    again, _ = write_study(clips, tmp_path / "again", seed=1)
    assert again.read_text() != text


def test_the_evaluation_offers_it(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--study", str(clips), "-o", str(tmp_path / "a")]) == 0
    assert main(["study", str(clips), "-o", str(tmp_path / "b")]) == 0
    assert (tmp_path / "a" / PAGE).read_bytes() == (tmp_path / "b" / PAGE).read_bytes()
    assert main(["evaluate", "-o", str(tmp_path / "c")]) == 2
    assert "--study" in capsys.readouterr().err


def test_the_table_is_the_mean_of_the_answers(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = tmp_path / "study"
    assert main(["study", str(clips), "-o", str(study)]) == 0
    files = [
        answer(tmp_path / "a.csv", study / KEY, "a", {"ours": 5, "tiny-network": 3, "without aggregation": 1}),
        answer(tmp_path / "b.csv", study / KEY, "b", {"ours": 4, "tiny-network": 3, "without aggregation": 2}),
    ]
    assert main(["study", "--answers", *map(str, files), "-o", str(study)]) == 0
    table = (study / TABLE).read_text()
    assert table in capsys.readouterr().out
    assert "| | ours | tiny-network | without aggregation |" in table
    assert table.count("**4.50 ± 0.57** (4)") == 3 and table.count("3.00 ± 0.00 (4)") == 3 and "1.50" in table


def test_bad_answers_are_named(clips: Path, tmp_path: Path) -> None:
    _, key = write_study(clips, tmp_path / "study")
    good = answer(tmp_path / "a.csv", key, "a", dict.fromkeys(METHODS, 3))
    with pytest.raises(UikaError, match="answered before"):
        read_answers([good, good], key)
    bad = answer(tmp_path / "b.csv", key, "b", dict.fromkeys(METHODS, 6))
    with pytest.raises(UikaError, match=r"b\.csv: line 2: the score must be 1 to 5, not '6'"):
        read_answers([bad], key)
    (tmp_path / "c.csv").write_text("name,score\n")
    with pytest.raises(UikaError, match=r"c\.csv: is no filled questionnaire"):
        read_answers([tmp_path / "c.csv"], key)
    _, other = write_study(clips, tmp_path / "other", seed=4)
    with pytest.raises(UikaError, match="is of another study"):
        read_answers([good], other)
    with pytest.raises(UikaError, match="key of a study"):
        read_answers([good], tmp_path / "none.json")


def test_folders_that_make_no_study_are_named(clips: Path, tmp_path: Path) -> None:
    (clips / "ours" / "anna.png").unlink()
    with pytest.raises(UikaError, match="has other clips than the first method, such as 'anna'"):
        write_study(clips, tmp_path / "study")
    with pytest.raises(UikaError, match="needs two or more folders"):
        write_study(tmp_path / "clips" / "ours", tmp_path / "study")
    assert not (tmp_path / "study" / PAGE).exists()


def test_unrated_methods_have_no_mean(clips: Path, tmp_path: Path) -> None:
    _, key = write_study(clips, tmp_path / "study")
    table = write_table(read_answers([], key), tmp_path / "study").read_text()
    assert table.count("| - |") >= 3


def test_the_page_in_a_browser(clips: Path, tmp_path: Path) -> None:
    written, key = write_study(clips, tmp_path / "study")
    with page(tmp_path) as tab:
        tab.open(written.as_uri())
        tab.wait("!!document.getElementById('begin')")
        assert tab.run("document.getElementById('begin').disabled")
        tab.run(
            "participant.value = 'p, 1'; participant.dispatchEvent(new Event('input')); agree.click(); begin.click(); 1"
        )
        for _ in range(2):
            assert tab.run("document.getElementById('next').disabled")
            assert tab.run("document.querySelectorAll('#clips img').length") == 3
            tab.run("document.querySelectorAll('input[value=\"4\"]').forEach((each) => each.click()); 1")
            assert not tab.run("document.getElementById('next').disabled")
            tab.run("document.getElementById('next').click(); 1")
        (tmp_path / "answers.csv").write_text(tab.run("csv()"))
        assert not tab.problems
    ratings = read_answers([tmp_path / "answers.csv"], key)
    assert [(rating.count, rating.mean) for rating in ratings] == [(2, 4.0)] * 9
