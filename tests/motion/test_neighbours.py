"""Recordings of other programs, as they are really written."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from uika.cli.program import warnings_as_sentences
from uika.errors import UikaWarning
from uika.head import HeadModel, load_head
from uika.head.actions import ARKIT_ACTIONS
from uika.motion import MotionError, read_csv, read_json, read_motion
from uika.motion.action_names import find_action
from uika.motion.frame_times import rate_of

JAW = ARKIT_ACTIONS.index("jawOpen")
AMOUNTS = [round(0.01 * k, 2) for k in range(52)]
SIDED = [name for name in ARKIT_ACTIONS if name.endswith(("Left", "Right"))]


def write(folder: Path, content: Any, name: str = "face.json", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes((content if isinstance(content, str) else json.dumps(content)).encode(encoding))
    return path


def named(value: float | None) -> dict[str, float | None]:
    return dict.fromkeys(ARKIT_ACTIONS, value)


def snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name)


SPELLINGS = {
    "apple": lambda n: n.replace("Left", "_L").replace("Right", "_R") if len(n) > 10 else n,
    "letter": lambda n: n.removesuffix("Left") + "L" if n.endswith("Left") else n,
    "capitals": lambda n: n.upper(),
    "snake": snake,
    "spaces": lambda n: snake(n).replace("_", " "),
    "object": lambda n: f"Face.blendShapes:{n}",
    "side first": lambda n: "Left" + n.removesuffix("Left") if n.endswith("Left") else n,
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("kind", ["json", "csv"])
def test_spellings_of_actions(spelling: str, kind: str, tmp_path: Path) -> None:
    names = [SPELLINGS[spelling](name) for name in ARKIT_ACTIONS]
    if kind == "json":
        found = read_json(write(tmp_path, [dict(zip(names, AMOUNTS, strict=True))]))
    else:
        found = read_csv(write(tmp_path, ",".join(names) + "\n" + ",".join(map(str, AMOUNTS)) + "\n", "face.csv"))
    torch.testing.assert_close(found.expression[0], torch.tensor(AMOUNTS))


def test_no_spelling_means_two_actions() -> None:
    for name in SIDED:
        base = name.removesuffix("Left").removesuffix("Right")
        side = name.removeprefix(base)
        assert {find_action(t) for t in (f"{base}_{side[0]}", f"{base}{side[0]}", f"{side}_{base}")} == {name}


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["jawOpen", "eyeBlinkLeftt"], r"'eyeBlinkLeftt' \(meant eyeBlinkLeft\?\)"),
        (["jawOpen", "mouthSmle_L"], r"'mouthSmle_L' \(meant mouthSmileLeft\?\)"),
        (["jawOpen", "viseme_aa", "viseme_PP"], "'viseme_aa', 'viseme_PP'"),
        (["jawOpen", *(f"cheek{k}" for k in range(9))], "and 4 more"),
        (["jawOpen", "JawOpen"], "jawOpen twice"),
        (["eyeBlinkLeft", "eyeBlink_L"], "eyeBlinkLeft twice"),
    ],
)
def test_names_that_are_not_understood_are_listed(names: list[str], says: str, tmp_path: Path) -> None:
    values = ",".join("0.5" for _ in names)
    for path, read in (
        (write(tmp_path, [dict.fromkeys(names, 0.5)]), read_json),
        (write(tmp_path, ",".join(names) + f"\n{values}\n", "face.csv"), read_csv),
    ):
        with pytest.raises(MotionError, match=rf"face\.\w+: .*{says}"):
            read(path)


@pytest.mark.parametrize(
    ("value", "says"),
    [(50, "percent"), (100, "percent"), (1.7, "lie in 0 to 1"), (-40, "lie in 0 to 1"), (1e30, "lie in 0 to 1")],
)
def test_activations_far_outside_are_refused(value: float, says: str, tmp_path: Path) -> None:
    for path, read, row in (
        (write(tmp_path, [named(0.1), {**named(0.2), "jawOpen": value}]), read_json, "frame 1"),
        (write(tmp_path, f"EyeBlinkLeft,JawOpen\n0,0.5\n0.1,{value}\n", "face.csv"), read_csv, "line 3"),
    ):
        with pytest.raises(MotionError, match=rf"jawOpen is .* in {row}; .*{says}"):
            read(path)


@pytest.mark.parametrize("value", [1.05, 1.4, -0.02])
def test_activations_a_little_outside_are_kept_and_named(value: float, tmp_path: Path) -> None:
    path = write(tmp_path, [named(0.1), {**named(0.2), "jawOpen": value}])
    with pytest.warns(UikaWarning, match=r"face\.json: jawOpen is .* in frame 1"):
        assert float(read_json(path).expression[1, JAW]) == pytest.approx(value)


def category(name: str, value: float) -> dict[str, Any]:
    return {"index": 1, "score": value, "categoryName": name, "displayName": ""}


def categories(key: str = "categoryName") -> list[dict[str, Any]]:
    named_ones = [{key: n, "score": v} for n, v in zip(ARKIT_ACTIONS, AMOUNTS, strict=True)]
    return [{key: "_neutral", "score": 0.0}, *named_ones]


LAYOUTS: dict[str, Any] = {
    "names and weights with times": {
        "names": list(ARKIT_ACTIONS),
        "metadata": {"fps": 30.0, "frame_count": 2},
        "frames": [{"weights": AMOUNTS, "time": k / 30, "rotation": []} for k in range(2)],
    },
    "names of its metadata": {
        "metadata": {"fps": 30, "blendshape_names": list(ARKIT_ACTIONS)},
        "frames": [{"weights": AMOUNTS}] * 2,
    },
    "matrix": {"exportFps": 30.0, "numFrames": 2, "facsNames": list(ARKIT_ACTIONS), "weightMat": [AMOUNTS] * 2},
    "curves": {"fps": 30, **{n: [v, v] for n, v in zip(ARKIT_ACTIONS, AMOUNTS, strict=True)}},
    "curves inside": {"fps": 30, "blendShapes": {n: [v, v] for n, v in zip(ARKIT_ACTIONS, AMOUNTS, strict=True)}},
    "categories": {"fps": 30, "frames": [categories(), categories()]},
    "categories of results": {"fps": 30, "frames": [{"faceBlendshapes": [{"categories": categories()}]}] * 2},
    "categories in snake case": {"fps": 30, "frames": [{"face_blendshapes": [categories("category_name")]}] * 2},
    "times in milliseconds": [
        {"timestamp_ms": round(1000 * k / 30), "blendShapes": dict(zip(ARKIT_ACTIONS, AMOUNTS, strict=True))}
        for k in range(4)
    ],
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_neighbours(layout: str, tmp_path: Path) -> None:
    found = read_json(write(tmp_path, LAYOUTS[layout]))
    assert found.fps == pytest.approx(30) and len(found) in (2, 4)
    torch.testing.assert_close(found.expression, torch.tensor(AMOUNTS).expand(len(found), -1))


def test_one_result_and_one_pose_a_line(tmp_path: Path) -> None:
    torch.testing.assert_close(read_json(write(tmp_path, categories())).expression[0], torch.tensor(AMOUNTS))
    lines = "\n".join(json.dumps({"time": k / 24, **named(0.1 * k)}) for k in range(5))
    found = read_json(write(tmp_path, lines))
    assert found.fps == pytest.approx(24) and len(found) == 5


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"names": ["jawOpen"], "frames": [[0.5], [0.5, 0.1]]}, "frame 1 has 2 weights for 1 names"),
        ([[0.5] * 52], "numbers without names"),
        ({"jawOpen": [0.1, 0.2], "jawLeft": [0.1]}, "different lengths"),
        ({"names": "jawOpen", "frames": [[0.5]]}, "no list of words"),
        ({"frames": [{"jawOpen": {"x": 1}}]}, "no number"),
        ({"fps": 0, "frames": [named(0.1)]}, "more than 0"),
        ([{"time": 1 - k, **named(0.1)} for k in range(3)], "do not rise"),
        ([{"time": t, **named(0.1)} for t in (0, 0.1, 0.2, 1e9)], "are the most"),
        ("[0.5", "JSON"),
    ],
)
def test_json_that_is_not_understood_says_why(content: Any, says: str, tmp_path: Path) -> None:
    with pytest.raises(MotionError, match=rf"face\.json: .*{says}"):
        read_json(write(tmp_path, content))


@pytest.mark.parametrize("rate", [24, 25, 29.97, 48, 60])
def test_times_of_frames_are_honoured(rate: float, tmp_path: Path) -> None:
    frames = [{"time": 7 + k / rate, "blendShapes": named(k / 100)} for k in range(60)]
    found = read_json(write(tmp_path, {"frames": frames}))
    assert found.fps == pytest.approx(rate, rel=1e-5) and len(found) == 60


@pytest.mark.parametrize("missing", [range(10, 30), range(1, 60, 3), [5, 6, 40]])
@pytest.mark.parametrize("kind", ["json", "table", "timecodes"])
def test_uneven_times_keep_the_length(missing: Any, kind: str, tmp_path: Path) -> None:
    kept = [k for k in range(120) if k not in missing]
    if kind == "json":
        found = read_json(write(tmp_path, [{"timestamp": k / 30, "jawOpen": k / 120} for k in kept]))
    elif kind == "table":
        rows = "".join(f"{1000 * k / 30:.0f};{f'{k / 120:.6f}'.replace('.', ',')}\n" for k in kept)
        found = read_csv(write(tmp_path, "Timestamp;JawOpen\n" + rows, "face.csv"))
    else:
        rows = "".join(f"23:59:{57 + k // 30 if k < 90 else 0}:{k % 30:02d}.000,{k / 120}\n" for k in kept)
        rows = rows.replace("23:59:0:", "00:00:00:")
        found = read_csv(write(tmp_path, "Timecode,JawOpen\n" + rows, "face.csv"))
    assert len(found) / found.fps == pytest.approx(4.0, abs=0.05)
    want = torch.arange(len(found)) / found.fps / 4
    torch.testing.assert_close(found.expression[:, JAW], want, atol=0.012, rtol=0)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-8"])
@pytest.mark.parametrize(("mark", "end"), [(",", "\r\n"), (";", "\n"), ("\t", "\n")])
def test_text_as_other_systems_write_it(encoding: str, mark: str, end: str, tmp_path: Path) -> None:
    number = "0,25" if mark == ";" else "0.25"
    table = end.join([mark.join(["JawOpen", "EyeBlinkLeft", ""]), mark.join([number, number, ""]), ""])
    assert float(read_csv(write(tmp_path, table, "face.csv", encoding)).expression[0, JAW]) == 0.25
    text = json.dumps({"jawOpen": 0.25}, indent=1).replace("\n", end)
    assert float(read_json(write(tmp_path, text, "face.json", encoding)).expression[0, JAW]) == 0.25


@pytest.mark.parametrize("gap", [None, {}, {"blendShapes": None}, {"blendShapes": []}, {"weights": None}, named(None)])
def test_frames_without_a_face_are_filled_in(gap: Any, tmp_path: Path) -> None:
    frames = [{"blendShapes": named(0.2)}, gap, gap, {"blendShapes": named(0.8)}]
    with pytest.warns(UikaWarning, match="filled in"):
        found = read_json(write(tmp_path, {"fps": 30, "frames": frames}))
    torch.testing.assert_close(found.expression[:, JAW], torch.tensor([0.2, 0.4, 0.6, 0.8]))


@pytest.mark.parametrize("row", ["{},0", "{},0,", "{},0,,"])
def test_rows_of_a_table_without_a_face_are_filled_in(row: str, tmp_path: Path) -> None:
    stamps = [f"01:00:00:{k:02d}.000" for k in range(4)]
    rows = [f"{stamps[0]},61,0.2,0.1", row.format(stamps[1]), row.format(stamps[2]), f"{stamps[3]},61,0.8,0.1"]
    path = write(tmp_path, "\n".join(["Timecode,BlendShapeCount,JawOpen,JawLeft", *rows]), "face.csv")
    with pytest.warns(UikaWarning, match=r"face\.csv: no face in 2 of 4 frames, the first at line 3"):
        found = read_csv(path)
    torch.testing.assert_close(found.expression[:, JAW], torch.tensor([0.2, 0.4, 0.6, 0.8]))


@pytest.mark.parametrize("row", ["0.5", "0.5,half", "0.5,0.5,0.5"])
def test_damaged_lines_are_named(row: str, tmp_path: Path) -> None:
    with pytest.raises(MotionError, match=r"face\.csv: line 3 is damaged"):
        read_csv(write(tmp_path, f"JawOpen,JawLeft\n0.1,0.1\n{row}\n", "face.csv"))


def test_head_turns_that_are_not_read_are_spoken_of(tmp_path: Path) -> None:
    frames = [{"weights": AMOUNTS, "rotation": [0.1, 0.2, 0.3]}]
    with pytest.warns(UikaWarning, match="rotations"):
        read_json(write(tmp_path, {"names": list(ARKIT_ACTIONS), "frames": frames}))


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.mark.parametrize("name", ["a.NPZ", "a.Npz", "a.CSV", "a.Json", "flame.NPZ"])
def test_endings_in_capitals(name: str, head: HeadModel, tmp_path: Path) -> None:
    path = tmp_path / name
    if name.startswith("flame"):
        with path.open("wb") as file:
            np.savez(file, expr=np.zeros((2, 50), np.float32))
        with pytest.raises(MotionError, match="FLAME expressions"):
            read_motion(path, head)
        return
    if name.lower().endswith("npz"):
        with path.open("wb") as file:
            np.savez(file, fps=25.0, rotation=np.zeros((3, 3), np.float32))
    elif name.lower().endswith("csv"):
        path.write_text("JawOpen\n0.1\n0.2\n0.3\n")
    else:
        path.write_text(json.dumps([{"jawOpen": 0.1}] * 3))
    assert len(read_motion(path, head)) == 3


def test_the_frame_that_is_not_finite_is_named(head: HeadModel, tmp_path: Path) -> None:
    turns = np.zeros((4, 3), np.float32)
    turns[2, 1] = np.nan
    np.savez(tmp_path / "m.npz", fps=25.0, rotation=turns)
    with pytest.raises(MotionError, match="'rotation' holds values that are not finite, first in frame 2"):
        read_motion(tmp_path / "m.npz", head)


def test_warnings_are_one_line_of_the_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, {"fps": 30, "frames": [named(0.2), None, named(0.4)]})
    before, shown = list(warnings.filters), warnings.showwarning
    with warnings_as_sentences():
        read_json(path)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        f"uika: warning: {path}: no face in 1 of 3 frames, the first at frame 1; filled in from their neighbours"
    ]
    assert (warnings.filters, warnings.showwarning) == (before, shown)


@pytest.mark.parametrize(
    "kept",
    [
        [k for k in range(36) if k % 3 != 1],  # every third lost: more long steps than short ones
        [k for k in range(36) if not 11 < k < 21],
        [*range(18), *range(18, 36, 2)],
    ],
)
@pytest.mark.parametrize("rate", [25, 30, 60])
def test_the_rate_is_that_at_which_frames_were_lost(kept: list[int], rate: int) -> None:
    # Whole milliseconds over half a second cannot tell 60 from 59.94.
    assert rate_of(np.round(np.array(kept) / rate, 3)) == pytest.approx(rate, rel=2e-3)


def test_steps_that_are_no_multiples_have_their_usual_rate() -> None:
    steps = np.random.default_rng(0).uniform(0.028, 0.045, 200)
    assert rate_of(np.cumsum(steps)) == pytest.approx(1 / np.median(steps), rel=0.01)
