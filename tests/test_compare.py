import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.compare import compare, main, read

FIGURES: dict[str, Any] = {
    "machine": {"cores": 2, "load": [1.5]},
    "scenes": [
        {"scene": "30k", "side": 256, "forward": "8.3 / 16.2", "peak MB": "604", "pairs": 1000, "speedup": "42x"},
        {"scene": "130k", "side": 512, "forward": "36.6 / 48.6", "peak MB": "900", "pairs": 5000, "speedup": "51x"},
    ],
    "fit": {"vertex mm": 0.78, "psnr": 30.85, "mask_iou": 0.95},
    "frames per second": 60.0,
    "film": {"frames/s": 60, "cpu_ms_per_image": 40, "lowest score": 8, "patches": 7},
    "thresholds": [{"setting": "1e-2", "f + b ms": "20.0"}, {"setting": "1/255", "f + b ms": "30.0"}],
}


def write(path: Path, figures: Any) -> Path:
    path.write_text(json.dumps(figures))
    return path


def changed(*place: Any, to: Any) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads(json.dumps(FIGURES))
    spot: Any = figures
    for key in place[:-1]:
        spot = spot[key]
    spot[place[-1]] = to
    return figures


def run(folder: Path, figures: Any) -> int:
    return main([str(write(folder / "old.json", FIGURES)), str(write(folder / "new.json", figures))])


def test_equal_files_pass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, FIGURES) == 0
    assert "0 worse, 0 better, 0 gone" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("figures", "line"),
    [
        (changed("scenes", 0, "forward", to="16.6 / 16.2"), "slower x2.00: scenes[scene=30k side=256]/forward#1"),
        (changed("fit", "vertex mm", to=1.17), "less accurate x1.50: fit/vertex mm: 0.78 -> 1.17"),
        (changed("fit", "psnr", to=24.83), "less accurate x2.00: fit/psnr"),
        (changed("fit", "mask_iou", to=0.9), "less accurate x2.00: fit/mask_iou"),
        (changed("frames per second", to=30.0), "slower x2.00: frames per second"),
        (changed("scenes", 1, "speedup", to="10x"), "slower x5.10: scenes[scene=130k side=512]/speedup"),
        (changed("film", "frames/s", to=30), "slower x2.00: film/frames per s: 60 -> 30"),
        (changed("film", "cpu_ms_per_image", to=80), "slower x2.00: film/cpu_ms_per_image: 40 -> 80"),
        (changed("film", "lowest score", to=4), "less accurate x2.00: film/lowest score: 8 -> 4"),
        (changed("thresholds", 0, "f + b ms", to="40.0"), "slower x2.00: thresholds[setting=1e-2]/f + b ms: 20 -> 40"),
    ],
)
def test_what_got_worse_is_named(
    figures: dict[str, Any], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, figures) == 1
    out = capsys.readouterr().out
    assert line in out and "1 worse, 0 better" in out


@pytest.mark.parametrize(
    "figures",
    [
        changed("scenes", 0, "forward", to="4.1 / 16.2"),
        changed("fit", "psnr", to=37.0),
        changed("frames per second", to=120.0),
    ],
)
def test_gains_pass(figures: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, figures) == 0
    assert "0 worse, 1 better" in capsys.readouterr().out


@pytest.mark.parametrize(
    "figures",
    [
        changed("scenes", 0, "pairs", to=5000),
        changed("film", "patches", to=70),
        changed("machine", "load", to=[9.9]),
        changed("scenes", to=FIGURES["scenes"][::-1]),
        changed("fit", "vertex mm", to=0.8),
    ],
    ids=["count", "another count", "machine", "order of rows", "within the limit"],
)
def test_what_is_no_loss_passes(figures: dict[str, Any], tmp_path: Path) -> None:
    assert run(tmp_path, figures) == 0


def test_rounding_is_no_loss(tmp_path: Path) -> None:
    old, new = (
        write(tmp_path / "a.json", {"ms": 0.0, "error": 0.1}),
        write(tmp_path / "b.json", {"ms": 0.1, "error": 0.2}),
    )
    changes = {change.place: change for change in compare(read(old), read(new))}
    assert changes["ms"].least == 1.0
    assert changes["error"].least == pytest.approx(1.0)
    write(new, {"ms": 0.2, "error": 0.3})
    assert main([str(old), str(new)]) == 1


def test_limits_can_be_chosen(tmp_path: Path) -> None:
    files = [str(write(tmp_path / "a.json", {"wall ms": 10.0})), str(write(tmp_path / "b.json", {"wall ms": 12.0}))]
    assert main(files) == 0
    assert main([*files, "--slower", "1.1"]) == 1


def test_what_is_gone_is_a_loss(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = {key: value for key, value in FIGURES.items() if key != "fit"}
    assert run(tmp_path, figures) == 1
    assert "gone: fit/psnr" in capsys.readouterr().out


@pytest.mark.parametrize("content", ["", "{", "[]", '{"note": "none"}'])
def test_files_without_results_are_refused(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.json").write_text(content)
    good = write(tmp_path / "good.json", FIGURES)
    assert main([str(good), str(tmp_path / "bad.json")]) == 2
    assert "bad.json" in capsys.readouterr().err
    assert main([str(tmp_path / "none.json"), str(good)]) == 2
    assert "none.json" in capsys.readouterr().err
