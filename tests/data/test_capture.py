import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from uika.data import DataError, open_capture
from uika.head import look_at, project

FRAMES = 4


def write_capture(folder: Path) -> list[dict[str, Any]]:
    """A capture as VHAP exports it, with cameras in OpenGL axes."""
    generator = np.random.default_rng(0)
    entries = []
    for kind in ("images", "fg_masks", "flame_param"):
        (folder / kind).mkdir(parents=True)
    for index in range(FRAMES):
        camera = look_at(yaw=20 * index, size=(24, 16))
        to_world = np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([1, -1, -1, 1])
        Image.fromarray(generator.integers(0, 256, (16, 24, 3), np.uint8)).save(folder / f"images/{index:05d}_00.png")
        Image.fromarray(np.full((16, 24), 40 * index, np.uint8)).save(folder / f"fg_masks/{index:05d}_00.png")
        pose = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3, "expr": 100}
        arrays: dict[str, Any] = {name: generator.normal(size=(1, size)) for name, size in pose.items()}
        np.savez(folder / f"flame_param/{index:05d}.npz", **arrays)
        entries.append(
            {
                "timestep_index": index,
                "camera_id": "00",
                "fl_x": float(camera.K[0, 0]),
                "fl_y": float(camera.K[1, 1]),
                "cx": 12.0,
                "cy": 8.0,
                "transform_matrix": to_world.tolist(),
                "file_path": f"images/{index:05d}_00.png",
                "fg_mask_path": f"fg_masks/{index:05d}_00.png",
                "flame_param_path": f"flame_param/{index:05d}.npz",
            }
        )
    np.savez(folder / "canonical_flame_param.npz", shape=np.arange(300.0)[None], static_offset=np.ones((1, 7, 3)))
    save(folder, entries)
    return entries


def save(folder: Path, entries: list[dict[str, Any]]) -> None:
    (folder / "transforms.json").write_text(json.dumps({"frames": entries}))


@pytest.fixture
def capture(tmp_path: Path) -> tuple[Path, list[dict[str, Any]]]:
    folder = tmp_path / "037_EXP-1"
    return folder, write_capture(folder)


def test_frames_are_read_as_written(capture: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, _ = capture
    found = open_capture(folder, strict=True)
    assert len(found) == FRAMES and not found.skipped
    for index, sample in enumerate(found.samples(strict=True)):
        camera = look_at(yaw=20 * index, size=(24, 16))
        points = torch.tensor([[0.02, 0.03, 0.05], [-0.04, 0.0, 0.01]])
        torch.testing.assert_close(project(points, sample.camera)[0], project(points, camera)[0], atol=1e-3, rtol=0)
        assert (sample.identity, sample.timestep, sample.camera_id) == ("037", index, "00")
        pixels = np.array(Image.open(folder / f"images/{index:05d}_00.png"))
        np.testing.assert_allclose(sample.image.permute(1, 2, 0) * 255, pixels, atol=1e-3)
        assert float(sample.mask.max()) == pytest.approx(40 * index / 255)
        assert sample.parameters is not None and sample.static_offset is not None
        torch.testing.assert_close(sample.parameters.identity, torch.arange(300.0))
        expected = np.load(folder / f"flame_param/{index:05d}.npz")["eyes_pose"][0]
        np.testing.assert_allclose(sample.parameters.eyes, expected, atol=1e-6)
        assert sample.static_offset.shape == (7, 3)


def break_image(folder: Path, entries: list[dict[str, Any]]) -> None:
    (folder / entries[1]["file_path"]).unlink()


def break_camera(folder: Path, entries: list[dict[str, Any]]) -> None:
    entries[1]["transform_matrix"][0][3] = float("nan")


def break_focal(folder: Path, entries: list[dict[str, Any]]) -> None:
    entries[1]["fl_x"] = -3.0


def break_matrix(folder: Path, entries: list[dict[str, Any]]) -> None:
    entries[1]["transform_matrix"] = [[1, 0], [0, 1]]


def break_path(folder: Path, entries: list[dict[str, Any]]) -> None:
    (folder.parent / "secret.png").write_bytes((folder / entries[0]["file_path"]).read_bytes())
    entries[1]["file_path"] = "../secret.png"


def break_entry(folder: Path, entries: list[dict[str, Any]]) -> None:
    del entries[1]["cx"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (break_image, "00001_00.png: is missing"),
        (break_camera, "frame 1: the camera holds values that are not finite"),
        (break_focal, "frame 1: fl_x and fl_y"),
        (break_matrix, "frame 1: transform_matrix"),
        (break_path, "frame 1: file_path '../secret.png' leads out of the folder"),
        (break_entry, "frame 1 lacks cx"),
    ],
)
def test_bad_frames_are_skipped_or_refused(
    capture: tuple[Path, list[dict[str, Any]]], damage: Any, message: str
) -> None:
    folder, entries = capture
    damage(folder, entries)
    save(folder, entries)
    found = open_capture(folder)
    assert len(found) == FRAMES - 1 and len(found.skipped) == 1
    assert message in found.skipped[0] and str(folder) in found.skipped[0]
    with pytest.raises(DataError, match=message.replace("(", "\\(")):
        open_capture(folder, strict=True)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("fg_masks/00001_00.png", None, "has 3x2 pixels, its image 24x16"),
        ("images/00001_00.png", b"not an image", "00001_00.png: is not a readable image"),
        ("flame_param/00001.npz", b"not an archive", "00001.npz: cannot be read"),
    ],
)
def test_bad_files_are_skipped_or_refused(
    capture: tuple[Path, list[dict[str, Any]]], file: str, content: bytes | None, message: str
) -> None:
    folder, _ = capture
    if content is None:
        Image.fromarray(np.zeros((2, 3), np.uint8)).save(folder / file)
    else:
        (folder / file).write_bytes(content)
    found = open_capture(folder)
    assert [sample.timestep for sample in found.samples()] == [0, 2, 3]
    with pytest.raises(DataError, match=message):
        list(found.samples(strict=True))


def test_torn_descriptions_are_refused(capture: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> None:
    folder, _ = capture
    description = folder / "transforms.json"
    description.write_text(description.read_text()[:-200])
    with pytest.raises(DataError, match=r"transforms\.json: is not complete JSON"):
        open_capture(folder)
    description.write_text('{"frames": []}')
    with pytest.raises(DataError, match="no usable frame"):
        open_capture(folder)
    with pytest.raises(DataError, match=r"missing/transforms\.json"):
        open_capture(tmp_path / "missing")
