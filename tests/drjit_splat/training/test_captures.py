"""Data sets of three kinds show the same cameras, and unusable ones are named."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from drjit_splat.training import Capture, open_capture
from tests.drjit_splat.training.made_up import (
    COUNT,
    SIZE,
    cameras,
    scene,
    write_colmap,
    write_nerfstudio,
    write_pictures,
)


def everything(capture: Capture) -> dict[str, torch.Tensor]:
    return {photo.path.name: photo.viewmat for photo in (*capture.photos, *capture.held_out)}


@pytest.mark.parametrize("kind", ["nerfstudio", "text", "binary"])
def test_cameras_come_out_as_they_were(tmp_path: Path, kind: str) -> None:
    folder = write_nerfstudio(tmp_path) if kind == "nerfstudio" else write_colmap(tmp_path, binary=kind == "binary")
    capture = open_capture(folder)
    viewmats, K = cameras()
    assert len(capture.held_out) == 2 and len(capture.photos) == COUNT - 2
    assert [photo.path.name for photo in capture.held_out] == ["000.png", "008.png"]
    for index in range(COUNT):
        torch.testing.assert_close(everything(capture)[f"{index:03d}.png"], viewmats[index], atol=1e-5, rtol=0)
    torch.testing.assert_close(capture.photos[0].K, K)
    assert 3 < capture.extent < 4 and capture.centre.norm() < 0.5
    if kind != "nerfstudio":
        assert capture.points is not None and capture.colors is not None
        torch.testing.assert_close(capture.points, scene()["means"], atol=1e-6, rtol=0)
        torch.testing.assert_close(capture.colors, scene()["colors"], atol=2e-3, rtol=0)


def test_nerf_synthetic_says_what_is_held_out(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path)
    whole = json.loads((tmp_path / "transforms.json").read_text())
    angle = 2 * float(np.arctan(SIZE / 2 / whole["fl_x"]))
    frames = [frame | {"file_path": frame["file_path"].removesuffix(".png")} for frame in whole["frames"]]
    for name, part in (("train", frames[:9]), ("test", frames[9:])):
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": part}))
    (tmp_path / "transforms.json").unlink()
    capture = open_capture(tmp_path)
    assert (len(capture.photos), len(capture.held_out)) == (9, 3)
    torch.testing.assert_close(capture.photos[0].K, cameras()[1], atol=1e-4, rtol=0)


def test_pictures_shrink_with_their_cameras(tmp_path: Path) -> None:
    photo = open_capture(write_nerfstudio(tmp_path)).photos[0]
    assert photo.pixels().shape == (SIZE, SIZE, 4) and photo.pixels(3).shape == (16, 16, 4)
    small = photo.shrunk(3)
    assert (small.width, small.height) == (16, 16)
    torch.testing.assert_close(small.K[:2], photo.K[:2] / 3)
    torch.testing.assert_close(photo.pixels(3).mean((0, 1)), photo.pixels().mean((0, 1)), atol=2e-3, rtol=0)


def damaged(tmp_path: Path, kind: str) -> Path:
    """A data set with one fault."""
    if kind == "empty":
        return tmp_path
    if kind == "missing picture":
        folder = write_nerfstudio(tmp_path)
        (folder / "images" / "003.png").unlink()
        return folder
    if kind == "another size":
        folder = write_nerfstudio(tmp_path, w=SIZE + 1)
        open_capture(folder).photos[0].pixels()
    if kind == "no rotation":
        folder = write_nerfstudio(tmp_path)
        document = json.loads((folder / "transforms.json").read_text())
        document["frames"][2]["transform_matrix"][0][0] = 3.0
        (folder / "transforms.json").write_text(json.dumps(document))
        return folder
    if kind == "transposed":
        folder = write_nerfstudio(tmp_path)
        document = json.loads((folder / "transforms.json").read_text())
        for frame in document["frames"]:
            frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()
        (folder / "transforms.json").write_text(json.dumps(document))
        return folder
    if kind == "no pose":
        folder = write_nerfstudio(tmp_path)
        document = json.loads((folder / "transforms.json").read_text())
        del document["frames"][1]["transform_matrix"]
        (folder / "transforms.json").write_text(json.dumps(document))
        return folder
    if kind == "no size":
        return write_nerfstudio(tmp_path, h=0)
    if kind == "long name":
        frames = [{"file_path": "x" * 5000, "transform_matrix": np.eye(4).tolist()}]
        return write_nerfstudio(tmp_path, frames=frames)
    if kind in ("few parameters", "short pose", "short point"):
        folder = write_colmap(tmp_path, binary=False)
        name, row = {"few parameters": ("cameras", 1), "short pose": ("images", 1), "short point": ("points3D", 0)}[
            kind
        ]
        table = folder / "sparse" / "0" / f"{name}.txt"
        lines = table.read_text().splitlines()
        words = lines[row].split()
        kept = {"cameras": words[:-1], "images": [*words[:5], *words[-2:]], "points3D": words[:5]}[name]
        table.write_text("\n".join([*lines[:row], " ".join(kept), *lines[row + 1 :]]) + "\n")
        return folder
    if kind == "distorted":
        return write_nerfstudio(tmp_path, k1=0.1)
    if kind == "no frames":
        return write_nerfstudio(tmp_path, frames=[])
    if kind == "not JSON":
        write_pictures(tmp_path / "images")
        (tmp_path / "transforms.json").write_text("{")
        return tmp_path
    if kind == "camera model":
        return write_colmap(tmp_path, binary=True, model=4)
    folder = write_colmap(tmp_path, binary=True)
    table = folder / "sparse" / "0" / "images.bin"
    if kind == "no cameras":
        (folder / "sparse" / "0" / "cameras.bin").write_bytes(b"\0" * 8)
    if kind == "unknown model":
        cameras = folder / "sparse" / "0" / "cameras.bin"
        cameras.write_bytes(cameras.read_bytes()[:12] + b"\x63" + cameras.read_bytes()[13:])
    if kind == "cut short":
        table.write_bytes(table.read_bytes()[:-30])
    if kind == "lying count":
        table.write_bytes(b"\xff" * 7 + b"\x0f" + table.read_bytes()[8:])
    if kind == "no images":
        table.write_bytes(b"\0" * 8)
    return folder


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("empty", "holds neither"),
        ("missing picture", r"003\.png.*not there"),
        ("another size", r"48x48 pixels; its camera says 49x48"),
        ("no rotation", "frame 2: its pose is no rotation"),
        ("transposed", "frame 0: its pose is no rotation with a translation"),
        ("no pose", r"frame 1 cannot be used \(KeyError: 'transform_matrix'\)"),
        ("no size", "frame 0: its picture cannot have 48 x 0 pixels"),
        ("long name", "the data set .* names this picture, which is not there"),
        ("few parameters", r"cameras\.txt.*PINHOLE has 4 parameters, not 3"),
        ("short pose", r"images\.txt.*no COLMAP table"),
        ("short point", r"points3D\.txt.*a point has 4 numbers"),
        ("distorted", r"undistort.*k1"),
        ("no frames", "no photos"),
        ("not JSON", r"transforms\.json: cannot be read as JSON"),
        ("camera model", "OPENCV bends rays"),
        ("no cameras", r"images\.bin: image '000\.png' has the camera 7, which .*cameras\.bin lacks"),
        ("unknown model", r"cameras\.bin: is no COLMAP table.*unknown camera model 99"),
        ("cut short", r"images\.bin: is no COLMAP table or is cut short"),
        ("lying count", r"images\.bin.*more than it holds"),
        ("no images", r"images\.bin: holds no image"),
    ],
)
def test_unusable_data_is_named(tmp_path: Path, kind: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        open_capture(damaged(tmp_path, kind))


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such data set"):
        open_capture(tmp_path / "nothing")
