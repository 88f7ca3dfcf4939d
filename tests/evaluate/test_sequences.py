import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from uika.data import Capture, DataError, open_capture
from uika.evaluate.sequences import choose_frames, facing, farthest_first
from uika.head import load_head


@pytest.fixture
def capture(people: Path) -> Path:
    return people / "captures" / "000000"


def test_mono_has_one_camera_and_other_moments(capture: Path) -> None:
    chosen = choose_frames(capture, "mono", 8, load_head())
    assert chosen.source_names == ("00000_00", "00002_00")
    assert chosen.target_names == ("00001_00",)
    assert [chosen.person.sample(index).key for index in chosen.targets] == ["000000_00001_00"]


def test_multi_has_all_cameras_and_other_moments(capture: Path) -> None:
    chosen = choose_frames(capture, "multi", 3, load_head())
    assert len(chosen.target_names) == 3 and len(set(chosen.source_names)) == 8
    assert {name[:5] for name in chosen.source_names} == {"00000", "00002"}
    assert {name[:5] for name in chosen.target_names} == {"00001"}
    cameras = [name[6:] for name in chosen.source_names]
    assert set(cameras[:4]) == set(cameras[4:]) == {"00", "01", "02", "03"}
    first = chosen.person.sample(chosen.sources[0])
    assert facing(first) > 0.95


def test_shards_and_captures_agree(people: Path) -> None:
    head = load_head()
    for setting in ("mono", "multi"):
        found = [choose_frames(people / place, setting, 4, head) for place in ("captures/000001", "shards/000001.tar")]
        assert found[0].name == found[1].name == "000001" and found[0].identity == found[1].identity
        assert found[0].source_names == found[1].source_names
        assert found[0].target_names == found[1].target_names


def some_frames(capture: Path, folder: Path, keep: set[tuple[int, str]]) -> Path:
    """A copy of the capture's description with only some (step, camera)."""
    content = json.loads((capture / "transforms.json").read_text())
    content["frames"] = [f for f in content["frames"] if (f["timestep_index"], str(f["camera_id"])) in keep]
    shutil.copytree(capture, folder, dirs_exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_one_moment_holds_out_cameras(capture: Path, tmp_path: Path) -> None:
    folder = some_frames(capture, tmp_path, {(0, f"{camera:02d}") for camera in range(4)})
    chosen = choose_frames(folder, "multi", 8, load_head())
    assert len(chosen.sources) == len(chosen.targets) == 2
    assert not set(chosen.source_names) & set(chosen.target_names)
    with pytest.raises(DataError, match="1 time steps and 1 cameras"):
        choose_frames(folder, "mono", 8, load_head())


def test_heads_of_another_model_are_refused(capture: Path, tmp_path: Path) -> None:
    file = capture / "canonical_flame_param.npz"
    with np.load(file) as arrays:
        short = {name: array[..., :-1] if name == "shape" else array for name, array in arrays.items()}
    folder = shutil.copytree(capture, tmp_path / "other")
    np.savez(folder / file.name, **short)
    with pytest.raises(DataError, match="another head model"):
        choose_frames(folder, "mono", 8, load_head())


def test_the_farthest_comes_next() -> None:
    line = torch.tensor([[0.0], [1.0], [2.0], [10.0], [6.0]])
    assert farthest_first(line) == [0, 3, 4, 2, 1]
    assert farthest_first(line[:1]) == [0]


def test_frames_are_the_captures(capture: Path) -> None:
    chosen = choose_frames(capture, "multi", 8, load_head())
    opened = open_capture(capture)
    assert isinstance(chosen.person, Capture)
    for index, name in zip(chosen.sources, chosen.source_names, strict=True):
        sample = opened.sample(index)
        assert f"{sample.timestep:05d}_{sample.camera_id}" == name
        assert np.isfinite(facing(sample))


def test_a_head_that_turned_away_is_no_source(capture: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(capture, tmp_path / "turned")
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    (file,) = {folder / frame["flame_param_path"] for frame in frames if frame["timestep_index"] == 2}
    with np.load(file) as arrays:
        turned = {**arrays, "rotation": np.asarray([[0.0, np.pi, 0.0]], dtype=np.float32)}
    np.savez(file, **turned)
    chosen = choose_frames(folder, "multi", 3, load_head())
    assert {name[:5] for name in chosen.source_names} == {"00000"}
    assert len(chosen.source_names) == 4 and len(chosen.target_names) == 3
