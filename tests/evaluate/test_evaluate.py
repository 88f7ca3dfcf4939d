import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from tests.metrics.lpips_files import write_weights
from tests.metrics.onnx_files import write_flatten
from uika.cli import main
from uika.data.views import View
from uika.errors import UikaError
from uika.evaluate import Evaluation, evaluate, evaluate_all, gather, write_report
from uika.evaluate.external import external_file
from uika.evaluate.reenactment import truth_picture
from uika.evaluate.sequences import choose_frames
from uika.head import load_head
from uika.io.video import write_png
from uika.metrics.arcface import SIDE
from uika.metrics.face_descriptor import SAME


@pytest.fixture
def copy(settings: Evaluation, tmp_path: Path) -> Evaluation:
    """Settings whose complete report may be changed."""
    return replace(settings, output=Path(shutil.copytree(settings.output, tmp_path / "report")))


def results(settings: Evaluation) -> dict[str, dict[str, Any]]:
    return {path.name: json.loads(path.read_text()) for path in settings.output.rglob("*.result.json")}


def test_more_views_and_good_scores(settings: Evaluation) -> None:
    (section,) = gather(settings.output)
    assert [row.views for row in section.rows] == [1, 2]
    values = {m.name: [row.value(m) for row in section.rows] for m in section.metrics}
    assert values["PSNR"][1] > values["PSNR"][0] > 17  # type: ignore[operator]
    assert values["SSIM"][1] > values["SSIM"][0] > 0.6  # type: ignore[operator]
    assert values["FLIP"][1] < values["FLIP"][0] < 0.3  # type: ignore[operator]
    assert values["FLIP masked"][1] > values["FLIP"][1]  # type: ignore[operator]
    for name in ("face distance", "AED", "APD", "AKD"):
        assert all(value is not None and value > 0 for value in values[name])
    assert values["LPIPS"] == values["CSIM"] == [None, None]


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.images.append(dict(attrs)["src"] or "")
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_report_has_tables_and_pictures(settings: Evaluation) -> None:
    markdown = (settings.output / "report.md").read_text()
    html = (settings.output / "report.html").read_text()
    for text in (markdown, html):
        assert "n/a: needs --lpips FILE" in text and "n/a: needs --arcface FILE" in text
        assert "96x96 pixels" in text and "rounded to 8 bits" in text
    page = Page(html)
    assert page.open == [] and len(page.images) == 8
    for name in page.images:
        with Image.open(settings.output / name) as picture:
            assert picture.size == (4 * 96, 96)
    assert all(f"]({name})" in markdown for name in page.images)
    with (settings.output / "sequences.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["sequence"], row["views"]) for row in rows] == [
        ("000000", "1"), ("000001", "1"), ("000000", "2"), ("000001", "2"),
    ]  # fmt: skip
    assert all(float(row["PSNR"]) > 15 and row["LPIPS"] == "n/a: needs --lpips FILE" for row in rows)


def test_complete_results_are_kept(copy: Evaluation) -> None:
    before = results(copy)
    outcome = evaluate(copy)
    assert (outcome.made, outcome.kept) == (0, 4)
    assert results(copy) == before
    assert "too few for 16 views" in outcome.missing[0]


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def foreign(file: Path) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | {"protocol": "another"}))


def lacking(file: Path) -> None:
    content = json.loads(file.read_text())
    content["scores"]["PSNR"].pop()
    file.write_text(json.dumps(content))


@pytest.mark.parametrize("spoil", [cut, foreign, lacking, Path.unlink])
def test_spoiled_results_do_not_count(spoil: Callable[[Path], None], copy: Evaluation) -> None:
    spoil(next(copy.output.rglob("000001_01.result.json")))
    write_report(copy.output)
    (section,) = gather(copy.output)
    assert [len(row.results) for row in section.rows] == [1, 2]


def test_a_torn_result_is_made_again(copy: Evaluation) -> None:
    before = results(copy)
    cut(next(copy.output.rglob("000001_01.result.json")))
    outcome = evaluate(replace(copy, views=(1,)))
    assert (outcome.made, outcome.kept) == (1, 1)
    after = results(copy)
    assert after.keys() == before.keys()
    scores = after["000001_01.result.json"]["scores"]
    for name, values in before["000001_01.result.json"]["scores"].items():
        assert scores[name] == (values if None in values else pytest.approx(values, abs=1e-9)), name


def test_other_choices_are_not_mixed(copy: Evaluation) -> None:
    with pytest.raises(UikaError, match="another size, background; choose another --name"):
        evaluate(replace(copy, size=64, background=0.0))
    (copy.output / "results" / "multi-self" / "none" / "protocol.json").write_text("{")
    with pytest.raises(UikaError, match=r"protocol\.json: cannot be read"):
        evaluate(copy)


def fill(folder: Path, settings: Evaluation, change: Callable[[torch.Tensor], torch.Tensor], driver: int) -> None:
    """Pictures of a system that knows the truth, or nearly, for one view."""
    names = ("000000", "000001")
    for index, name in enumerate(names):
        other = names[(index + driver) % 2]
        chosen = choose_frames(settings.data / "captures" / other, settings.setting, settings.targets, load_head())
        for at, target in zip(chosen.targets, chosen.target_names, strict=True):
            view = View(chosen.person.sample(at), settings.size)
            path = external_file(folder, name, 1, target)
            write_png(path, change(truth_picture(view, settings.background)))


def test_a_perfect_system_has_no_error(copy: Evaluation, tmp_path: Path) -> None:
    theirs = replace(copy, external=tmp_path / "theirs", views=(1,))
    fill(tmp_path / "theirs", theirs, lambda picture: picture, driver=0)
    assert evaluate(theirs).made == 2
    (section,) = gather(copy.output)
    assert [(row.protocol.method, row.views) for row in section.rows] == [("none", 1), ("theirs", 1), ("none", 2)]
    values = {m.name: section.rows[1].value(m) for m in section.metrics}
    assert values["PSNR"] == pytest.approx(120) and values["SSIM"] == pytest.approx(1)
    assert values["FLIP"] == values["AKD"] == 0
    assert [values["AED"], values["APD"]] == pytest.approx([0, 0], abs=1e-9)
    write_report(copy.output)
    assert "**120.00**" in (copy.output / "report.md").read_text()
    written = json.loads((copy.output / "results/multi-self/theirs/frames.json").read_text())
    assert written["000000"]["targets"] == ["00001_00", "00001_03"]


def test_a_system_that_copies_the_driver_has_its_expression(settings: Evaluation, tmp_path: Path) -> None:
    theirs = replace(settings, output=tmp_path / "r", external=tmp_path / "theirs", views=(1,), task="cross")
    fill(tmp_path / "theirs", theirs, lambda picture: picture, driver=1)
    evaluate(theirs)
    write_report(theirs.output)
    (section,) = gather(theirs.output)
    assert [metric.name for metric in section.metrics] == ["CSIM", "face distance", "AED", "APD", "AKD"]
    csim, distance, *others = [section.rows[0].value(metric) for metric in section.metrics]
    assert csim is None and distance is not None and distance > SAME, "the driver is another person"
    assert others == pytest.approx([0, 0, 0], abs=1e-9)
    assert [result.driver for result in section.rows[0].results] == ["000001", "000000"]


def test_missing_or_misfit_pictures_are_named(settings: Evaluation, tmp_path: Path) -> None:
    theirs = replace(settings, output=tmp_path / "r", external=tmp_path / "theirs", views=(1,))
    with pytest.raises(UikaError, match=r"000000/01/00001_00\.png: is missing, and so are 3 more of 4"):
        evaluate(theirs)
    assert not (tmp_path / "r" / "results").exists()
    fill(tmp_path / "theirs", theirs, lambda picture: picture[:64, :64], driver=0)
    with pytest.raises(UikaError, match="has 64x64 pixels, not 96x96"):
        evaluate(theirs)
    cut(external_file(tmp_path / "theirs", "000000", 1, "00001_00"))
    with pytest.raises(UikaError, match=r"00001_00\.png: cannot be read as a picture"):
        evaluate(theirs)


def test_pictures_without_faces_do_not_count(settings: Evaluation, tmp_path: Path) -> None:
    theirs = replace(settings, output=tmp_path / "r", external=tmp_path / "theirs", views=(1,), targets=1)
    fill(tmp_path / "theirs", theirs, lambda picture: torch.full_like(picture, 0.5), driver=0)
    evaluate(theirs)
    write_report(theirs.output)
    (section,) = gather(theirs.output)
    assert section.rows[0].counts[-1] == "0/2"
    cells = {metric.name: section.rows[0].cell(metric) for metric in section.metrics}
    assert cells["AED"] == cells["AKD"] == "-" and float(cells["PSNR"]) < 12


def test_pictures_alone_are_enough(settings: Evaluation, tmp_path: Path) -> None:
    """The head is fitted to what a detector finds."""
    one = settings.data / "captures" / "000000"
    alone = replace(settings, data=one, output=tmp_path / "r", correspondence="fit", views=(1,), targets=1)
    assert evaluate(alone).made == 1
    (section,) = gather(alone.output)
    values = {m.name: section.rows[0].value(m) or 99.0 for m in section.metrics}
    assert section.rows[0].counts[-1] == "1/1"
    assert values["APD"] < 0.3 and values["AED"] < 0.2 and values["AKD"] < 20 and values["PSNR"] > 15


def test_another_person_drives(settings: Evaluation, tmp_path: Path) -> None:
    crossed = replace(settings, output=tmp_path / "r", task="cross", setting="mono", views=(1,), targets=1)
    assert evaluate(crossed).made == 2
    (section,) = gather(crossed.output)
    values = {m.name: section.rows[0].value(m) or 99.0 for m in section.metrics}
    assert values["APD"] < 0.3 and values["AED"] < 0.2
    # Two faces that make the same expression differ in shape.
    assert values["AKD"] > 3
    with Image.open(next((tmp_path / "r" / "pictures").rglob("*.png"))) as strip:
        assert strip.size == (3 * 96, 96)


def test_given_networks_are_used(settings: Evaluation, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install onnxruntime to test CSIM")
    files = {
        "lpips": write_weights(tmp_path / "lpips.safetensors"),
        "arcface": write_flatten(tmp_path / "arcface.onnx", SIDE),
    }
    given = replace(settings, output=tmp_path / "r", external=tmp_path / "theirs", views=(1,), targets=1, **files)
    fill(tmp_path / "theirs", given, lambda picture: 0.5 * picture + 0.25, driver=0)
    evaluate(given)
    (section,) = gather(given.output)
    values = {m.name: section.rows[0].value(m) or 0.0 for m in section.metrics}
    assert values["LPIPS"] > 0 and 0.5 < values["CSIM"] < 0.9999


def test_the_command_prints_the_table(copy: Evaluation, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--data", str(copy.data), "-o", str(copy.output), "--setting", "multi", "--views", "1,2"]
    arguments += ["--model", "none", "--correspondence", "exact", "--size", "96", "--targets", "2"]
    assert main(["evaluate", *arguments]) == 0
    out = capsys.readouterr().out
    assert "| none | 2 | 2 | 4 | 4/4 |" in out and "0 results made, 4 were complete" in out
    assert "background: grey 1 in truth and result" in out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--views", "1,x"], "--views must be whole numbers"),
        (["--views", "0"], "views must be numbers from 1 to 64"),
        (["--size", "8"], "size must lie between"),
        (["--background", "2"], "background must be a grey level"),
        (["--targets", "0"], "targets must be at least 1"),
        (["--model", "other"], "other: no such model"),
        (["--lpips", "other.safetensors"], "other.safetensors: cannot be read"),
        (["--data", "nowhere"], "nowhere: no such folder"),
        (["--views", "33"], "too few for 33 views"),
    ],
)
def test_wrong_use_is_one_sentence(
    arguments: list[str], sentence: str, people: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--data", str(people), "-o", str(tmp_path / "r"), *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert sentence in error and len(error.splitlines()) == 1
    assert not (tmp_path / "r").exists()


def test_cross_needs_two_people(people: Path, tmp_path: Path) -> None:
    with pytest.raises(UikaError, match="cross reenactment needs two people, and only '000000'"):
        evaluate(Evaluation(people / "captures" / "000000", tmp_path / "r", task="cross", views=(1,)))


def test_settings_in_one_go_give_what_they_give_alone(settings: Evaluation, tmp_path: Path) -> None:
    wanted = [replace(settings, output=tmp_path, views=(1, 2), task=task) for task in ("self", "cross")]
    outcomes = evaluate_all(wanted)
    assert [(outcome.made, outcome.kept) for outcome in outcomes] == [(4, 0), (4, 0)]
    together, alone = results(wanted[0]), results(settings)
    for name, result in alone.items():
        for metric, values in result["scores"].items():
            assert together[name]["scores"][metric] == (
                values if None in values else pytest.approx(values, abs=1e-9)
            ), metric
    assert sorted(section.task for section in gather(tmp_path)) == ["cross", "self"]
