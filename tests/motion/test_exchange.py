"""Motions of other programs survive reading and writing."""

import json
import random
from pathlib import Path

import numpy as np
import pytest
import torch

from uika.head import HeadModel, load_head, rodrigues
from uika.head.actions import ARKIT_ACTIONS, has_actions
from uika.motion import (
    Motion,
    MotionError,
    load_motion,
    read_csv,
    read_flame_params,
    read_json,
    read_motion,
    save_motion,
    write_csv,
    write_flame_params,
    write_json,
)
from uika.motion.presets import get_motion


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture
def motion(head: HeadModel) -> Motion:
    base = get_motion("talk", head, 23.976)
    noise = torch.Generator().manual_seed(0)
    turned = 0.3 * torch.randn(len(base), 3, generator=noise)
    fields = {**base.tensors(), "rotation": turned, "yaw": torch.randn(len(base), generator=noise)}
    return Motion(fps=base.fps, **fields)


def flame_motion(frames: int = 5, expressions: int = 100) -> Motion:
    noise = torch.Generator().manual_seed(1)
    sizes = {"expression": expressions, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    return Motion(fps=25.0, **{k: 0.1 * torch.randn(frames, n, generator=noise) for k, n in sizes.items()})


def test_action_names_are_the_built_in_heads(head: HeadModel) -> None:
    assert len(ARKIT_ACTIONS) == 52
    assert set(ARKIT_ACTIONS) == set(head.expression_names)
    assert has_actions(head)


def test_npz_round_trip_is_exact(head: HeadModel, motion: Motion, tmp_path: Path) -> None:
    save_motion(motion, tmp_path / "motion.npz", head)
    again = load_motion(tmp_path / "motion.npz", head)
    assert again.fps == motion.fps
    assert set(again.tensors()) == set(motion.tensors())
    for name, value in motion.tensors().items():
        assert torch.equal(getattr(again, name), value), name
    with pytest.raises(MotionError, match="100 expressions"):
        save_motion(flame_motion(), tmp_path / "other.npz", head)


def test_json_of_52_names_in_any_order(head: HeadModel, motion: Motion, tmp_path: Path) -> None:
    path = tmp_path / "actions.json"
    write_json(motion, path, head.expression_names)
    content = json.loads(path.read_text())
    for index, frame in enumerate(content["frames"]):
        names = list(frame)
        random.Random(index).shuffle(names)
        content["frames"][index] = {name: frame[name] for name in names}
    path.write_text(json.dumps(content))
    again = read_motion(path, head)
    assert torch.equal(again.expression, motion.expression)
    assert again.fps == motion.fps


@pytest.mark.parametrize(
    "content",
    [
        {"JawOpen": 0.5},
        [{"jawOpen": 0.5}],
        {"fps": 60, "frames": [{"blendShapes": {"jawOpen": 0.5}}]},
        {"names": ["jawOpen"], "frames": [[0.5]]},
    ],
)
def test_kinds_of_json(content: object, tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(content))
    found = read_json(path)
    assert found.expression[0, ARKIT_ACTIONS.index("jawOpen")] == 0.5
    assert found.expression.sum() == 0.5


def test_csv_round_trip(head: HeadModel, tmp_path: Path) -> None:
    motion = get_motion("expressions", head, 30.0)
    turning = torch.linspace(-0.4, 0.4, 3 * len(motion)).view(-1, 3)
    motion = Motion(fps=30.0, **{**motion.tensors(), "neck": turning})
    path = tmp_path / "face.csv"
    write_csv(motion, path, head.expression_names)
    assert path.read_text().startswith("Timecode,BlendShapeCount,EyeBlinkLeft,EyeLookDownLeft")
    again = read_motion(path, head)
    assert again.fps == 30.0
    assert torch.equal(again.expression, motion.expression)
    torch.testing.assert_close(rodrigues(again.neck), rodrigues(motion.neck), atol=1e-5, rtol=0)


def test_flame_parameters_round_trip(tmp_path: Path) -> None:
    motion = flame_motion()
    write_flame_params(motion, tmp_path / "flame_param.npz")
    again = read_flame_params(tmp_path / "flame_param.npz")
    for name, value in motion.tensors().items():
        assert torch.equal(getattr(again, name), value), name
    folder = tmp_path / "capture" / "flame_param"
    folder.mkdir(parents=True)
    for index in range(len(motion)):
        fields = {name: value[index : index + 1] for name, value in motion.tensors().items()}
        write_flame_params(Motion(fps=25.0, **fields), folder / f"{index:05d}.npz")
    np.savez(folder.parent / "canonical_flame_param.npz", shape=np.zeros(300))
    for place in (folder, folder.parent):
        assert torch.equal(read_flame_params(place).expression, motion.expression)


def test_flame_parameters_need_a_flame_head(head: HeadModel, tmp_path: Path) -> None:
    write_flame_params(flame_motion(), tmp_path / "f.npz")
    with pytest.raises(MotionError, match="uika head import"):
        read_motion(tmp_path / "f.npz", head)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "x,y\n1,2\n", "names no ARKit actions"),
        ("a.csv", "JawOpen\nhalf\n", "damaged"),
        ("a.csv", "", "names no ARKit actions"),
        ("a.json", "{", "JSON"),
        ("a.json", "[]", "one pose"),
        ("a.json", '{"frames": [{"smirk": 1}]}', "names no ARKit actions"),
        ("a.json", '{"jawOpen": "wide"}', "no number but 'wide'"),
        ("a.json", '{"jawOpen": NaN}', "not finite"),
        ("a.txt", "", "is no motion"),
        ("a.npz", "", "plain arrays"),
    ],
)
def test_unusable_files_are_named(head: HeadModel, tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(MotionError, match=rf"{name}: .*{says}"):
        read_motion(tmp_path / name, head)


def test_frame_rate_follows_timecodes(tmp_path: Path) -> None:
    rows = ["Timecode,JawOpen"] + [f"10:00:{k // 24:02d}:{k % 24:02d}.000,0" for k in range(100)]
    (tmp_path / "t.csv").write_text("\n".join(rows))
    assert read_csv(tmp_path / "t.csv").fps == 24.0
