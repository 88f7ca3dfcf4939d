"""Captures as VHAP and GaussianAvatars export them."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.exports import CANONICAL_JAW, TEETH, bare_flame, picture, tracked, write_export, write_union
from tests.train.common import PaintedPerson
from uika.data import DataError, open_capture
from uika.data.datasets import find_people
from uika.data.head_crop import head_square
from uika.data.labels import check_parameters
from uika.data.views import View
from uika.head import load_head

NAMES = {"rotation": "rotation", "neck_pose": "neck", "jaw_pose": "jaw", "eyes_pose": "eyes", "expr": "expression"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("exports")
    return write_export(root / "306_EMO-1_v16_DS4_whiteBg_staticOffset_maskBelowLine")


def test_every_frame_keeps_its_own_pose(folder: Path) -> None:
    arrays = tracked(0, 4)
    found = open_capture(folder, strict=True)
    assert len(found) == 12
    for sample in found.samples(strict=True):
        assert sample.parameters is not None
        for name, field in NAMES.items():
            np.testing.assert_array_equal(getattr(sample.parameters, field), arrays[name][sample.timestep])
        assert abs(float(sample.parameters.jaw[0]) - CANONICAL_JAW) > 0.05
    assert len({sample.parameters.jaw[0].item() for sample in found.samples() if sample.parameters}) == 4


def test_shape_and_offset_come_from_the_canonical_file(folder: Path, tmp_path: Path) -> None:
    sample = open_capture(folder).sample(0)
    arrays = dict(np.load(folder / "canonical_flame_param.npz"))
    arrays["shape"] = arrays["shape"] + 1
    copy = write_export(tmp_path / "306_A", frames=1, cameras=1)
    np.savez(copy / "canonical_flame_param.npz", **arrays)
    changed = open_capture(copy).sample(0)
    assert sample.parameters is not None and changed.parameters is not None
    torch.testing.assert_close(changed.parameters.identity, sample.parameters.identity + 1)
    (copy / "canonical_flame_param.npz").unlink()
    own = open_capture(copy).sample(0)
    assert own.parameters is not None and own.static_offset is not None
    torch.testing.assert_close(own.parameters.identity, sample.parameters.identity)
    assert len(own.static_offset) == 5023


def test_teeth_are_left_out_and_said(folder: Path) -> None:
    found = open_capture(folder)
    offset = found.sample(0).static_offset
    assert offset is not None and offset.shape == (5023, 3) and float(offset.abs().max()) < 0.01
    assert any(f"the {TEETH} of the teeth are left out" in note for note in found.notes)


def test_offsets_of_other_shapes_are_refused(folder: Path, tmp_path: Path) -> None:
    copy = write_export(tmp_path / "306_B", frames=1, cameras=1)
    np.savez(copy / "canonical_flame_param.npz", shape=np.zeros(300), static_offset=np.zeros((7, 2)))
    with pytest.raises(DataError, match=r"canonical_flame_param.npz: array 'static_offset' has the shape \(7, 2\)"):
        open_capture(copy)


def test_joined_sequences_are_read_from_the_folders_beside_them(folder: Path) -> None:
    second = write_export(folder.parent / "306_EXP-2_v16", seed=1, frames=2)
    union = write_union(folder.parent / "UNION10_306_EMO1EXP2_v16", [folder, second])
    found = open_capture(union, strict=True)
    assert len(found) == 12 + 6
    assert {frame.timestep for frame in found.frames} == set(range(6))
    assert found.sample(0).identity == "306"
    assert find_people(union) == [union]
    # The folder of all holds each frame once: in its own sequence.
    assert find_people(folder.parent) == sorted([folder, second])
    description = union / "transforms_test.json"
    content = json.loads(description.read_text())
    (folder.parent / "secret.png").write_bytes((folder / "images/00000_00.png").read_bytes())
    for path in ("../secret.png", "../../secret.png", "/etc/hostname"):
        content["frames"][0]["file_path"] = path
        description.write_text(json.dumps(content))
        assert f"'{path}' leads out of the folder" in open_capture(union).skipped[0]


def test_the_head_fills_the_picture(folder: Path) -> None:
    head = bare_flame()
    sample = open_capture(folder).sample(4)
    before, after = View(sample, 128), View(sample, 128, head)

    def height(view: View) -> int:
        return int((view.mask > 0.5).any(1).sum())

    assert height(before) < 0.5 * 128 and 0.6 * 128 < height(after) < 0.85 * 128
    assert sample.parameters is not None
    truth, _ = picture(sample.parameters, tracked(0, 4)["static_offset"], after.camera, 0)
    shown = 255 * after.over(torch.ones(3)).permute(1, 2, 0).numpy()
    assert float(np.abs(shown - truth).mean()) < 2.5


def test_frames_that_a_head_fills_are_taken_whole() -> None:
    sample = PaintedPerson(0).sample(0)
    assert head_square(sample, load_head().without_bust) is None
    torch.testing.assert_close(View(sample, 64, load_head().without_bust).image, View(sample, 64).image, rtol=0, atol=0)


def test_many_frames_are_opened_in_seconds(folder: Path, tmp_path: Path) -> None:
    copy = write_export(tmp_path / "306_C", frames=1, cameras=1)
    content = json.loads((copy / "transforms.json").read_text())
    (entry,) = content["frames"]
    content["frames"] = [{**entry, "timestep_index": step} for step in range(10_000)]
    (copy / "transforms.json").write_text(json.dumps(content))
    start = time.process_time()
    assert len(open_capture(copy)) == 10_000
    assert time.process_time() - start < 3


def test_captures_that_cannot_be_trained_on_say_why(folder: Path, tmp_path: Path) -> None:
    sample = open_capture(folder).sample(0)
    with pytest.raises(
        DataError, match=r"_00000_222200036: has 300 identities, 100 expressions and 5,023 vertices, but"
    ) as caught:
        check_parameters(View(sample, 64), load_head())
    assert "give the capture's own with --head" in str(caught.value)
    bare = write_export(tmp_path / "306_D", frames=1, cameras=1)
    content = json.loads((bare / "transforms.json").read_text())
    del content["frames"][0]["flame_param_path"]
    (bare / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="has no head parameters; track the capture first"):
        check_parameters(View(open_capture(bare).sample(0), 64), bare_flame())


def test_offsets_that_move_with_time_are_said_to_be_unused(tmp_path: Path) -> None:
    copy = write_export(tmp_path / "306_E", frames=1, cameras=1)
    path = copy / "flame_param/00000.npz"
    arrays = dict(np.load(path))
    np.savez(path, **arrays, dynamic_offset=np.zeros((1, 5143, 3)))
    assert any("'dynamic_offset' of its frames is not used" in note for note in open_capture(copy).notes)
