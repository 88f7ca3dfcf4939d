"""Damaged files that once got past a reader's documented refusal; `tests.stress.fuzz` found them."""

from __future__ import annotations

import importlib
import json
import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from drjit_splat.cli import load_camera
from tests.flame_files import flame_arrays
from uika.errors import UikaError
from uika.export import glb_provenance, html_provenance, read_glb
from uika.head import HeadError
from uika.head_import import from_flame
from uika.head_import.flame_file import read_flame
from uika.io.radiance_hdr import read_hdr
from uika.io.sound import read_sound
from uika.io.video import write_video
from uika.model import CheckpointError, load_checkpoint
from uika.motion import MotionError, read_bvh
from uika.safeguards import verify
from uika.tracking.decode import decode, frame_rate

from .targets import TARGETS

DEEP = b'{"a":' * 100_000


def _seed(name: str, folder: Path) -> Path:
    return TARGETS[name].seeds(folder)[0]


@pytest.mark.parametrize("json_chunk", [DEEP, b"[" * 100_000])
def test_a_glb_nested_too_deep(json_chunk: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    total = 20 + len(json_chunk)
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 2, total, len(json_chunk), 0x4E4F534A) + json_chunk)
    for reader in (glb_provenance, read_glb, verify):
        with pytest.raises(UikaError, match=r"a\.glb: is damaged"):
            reader(path)


@pytest.mark.parametrize("scene", [DEEP.decode(), '{"provenance": {"a": ' + "9" * 5000 + "}}"])
def test_a_page_whose_scene_cannot_be_parsed_has_no_provenance(scene: str, tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(f'<script id="scene" type="application/json">{scene}')
    assert html_provenance(tmp_path / "a.html") == {}


@pytest.mark.parametrize("text", [DEEP.decode(), "9" * 5000, '[{"width": 1e400, "height": 3}]'])
def test_cameras_that_python_cannot_parse(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=r"a\.json"):
        load_camera(tmp_path / "a.json")


@pytest.mark.parametrize("field", ["fx", "position", "rotation", "width"])
def test_cameras_with_numbers_that_no_float_holds(field: str, tmp_path: Path) -> None:
    camera = json.loads((TARGETS["camera"].seeds(tmp_path)[1]).read_text())
    camera[field] = 10**400
    (tmp_path / "a.json").write_text(json.dumps(camera))
    with pytest.raises(ValueError, match=r"a\.json: camera 0 cannot be used"):
        load_camera(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"backbone": 1.5}, "unreadable config"),
        ({"backbone": True}, "unreadable config"),
        ({"gaussians": "x"}, "unreadable config"),
        ({"layers": 10**9, "outputs": [1, 2, 3, 10**9]}, "speaks of"),
        ({"layers": "4"}, "config"),
        ({"dim": -16}, "."),
    ],
)
def test_models_whose_config_makes_no_sense(change: dict[str, object], words: str, tmp_path: Path) -> None:
    path = _seed("model", tmp_path)
    _change_config(path, lambda config: json.dumps(json.loads(config) | change))
    with pytest.raises(CheckpointError, match=rf"a\.safetensors: .*{words}"):
        load_checkpoint(path)


def test_a_model_whose_config_is_nested_too_deep(tmp_path: Path) -> None:
    path = _seed("model", tmp_path)
    _change_config(path, lambda _: DEEP.decode())
    with pytest.raises(CheckpointError, match="unreadable config"):
        load_checkpoint(path)


def _change_config(path: Path, change: Callable[[str], str]) -> None:
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"]["config"] = change(header["__metadata__"]["config"])
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])


def test_a_video_whose_comment_is_not_text(tmp_path: Path) -> None:
    path = _seed("video", tmp_path)
    path.write_bytes(path.read_bytes().replace(b'{"photos"', b'\xff\xfe\xfdhotos"'))
    assert verify(path).provenance == {}
    assert len(list(decode(path))) == 4 and frame_rate(path) == 10


def test_a_video_of_an_unknown_kind(tmp_path: Path) -> None:
    path = _seed("phone_video", tmp_path)
    data = path.read_bytes()
    assert b"avc1" in data
    path.write_bytes(data.replace(b"avc1", b"zzz9"))
    for reader in (lambda p: list(decode(p)), frame_rate):
        with pytest.raises(UikaError, match=r"phone\.mp4: has pictures of a kind that FFmpeg does not know"):
            reader(path)


def test_a_video_without_pictures(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(UikaError, match=r"a\.mp4"):
        frame_rate(tmp_path / "a.mp4")


def test_a_picture_with_a_cut_header(tmp_path: Path) -> None:
    path = _seed("verify_picture", tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[:8] + struct.pack(">I", 5) + data[12:21] + b"\0\0\0\0" + data[21:])
    with pytest.raises(UikaError, match=r"a\.png"):
        verify(path)


def test_pictures_of_too_many_pixels_are_not_decoded(tmp_path: Path) -> None:
    path = _seed("verify_picture", tmp_path)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 8000, 8000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    with pytest.raises(UikaError, match="are the most"):
        verify(path)


def test_many_large_frames_are_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "a.mp4", torch.rand(30, 96, 128, 3), fps=10)
    monkeypatch.setattr(importlib.import_module("uika.safeguards.verification"), "_PIXELS_KEPT", 4 * 96 * 128)
    found = verify(tmp_path / "a.mp4")
    assert found.watermark is not None and found.watermark.frames <= 4


def test_a_torch_file_with_a_damaged_directory(tmp_path: Path) -> None:
    torch.save({"v_template": torch.zeros(3)}, tmp_path / "a.pt")
    data = (tmp_path / "a.pt").read_bytes()
    place = data.rindex(b"PK\x01\x02")
    (tmp_path / "a.pt").write_bytes(data[: place + 46] + b"\x97" + data[place + 47 :])
    with pytest.raises(HeadError, match=r"a\.pt: "):
        read_flame(tmp_path / "a.pt")


def test_torch_files_of_old_are_called_that(tmp_path: Path) -> None:
    torch.save({"v_template": torch.zeros(3)}, tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(HeadError, match=r"a\.pt: is a PyTorch file"):
        read_flame(tmp_path / "a.pt")


@pytest.mark.parametrize("line", ["vt 0.5", "vt", f"f 1/1 1/1 {10**30}/1", "f 1/1 1/1 1/"])
def test_meshes_with_damaged_lines(line: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "m.npz", **flame_arrays())
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nvt 0.5 0.5\nf 1/1 1/1 1/1\n{line}\n")
    with pytest.raises(HeadError, match=r"a\.obj: a line is damaged"):
        read_flame(tmp_path / "m.npz", tmp_path / "a.obj")


@pytest.mark.parametrize("mask", [np.zeros(0, np.int64), np.array(2), np.array([[0, 1]])])
def test_masks_of_odd_shapes(mask: np.ndarray, tmp_path: Path) -> None:
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({"scalp": mask, "face": np.array([3])}, 2))
    masks = from_flame._read_masks(tmp_path / "m.pkl", 5)
    assert masks["scalp"].sum() == mask.size and masks["face"].tolist() == [0, 0, 0, 1, 0]


def test_masks_that_are_no_vertex_numbers(tmp_path: Path) -> None:
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({"face": np.array([np.nan, 1.0])}))
    with pytest.raises(HeadError, match=r"m\.pkl: mask 'face' is no list of vertex numbers"):
        from_flame._read_masks(tmp_path / "m.pkl", 5)


def test_a_skeleton_that_would_be_read_forever(tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(
        "HIERARCHY ROOT Head { CHANNELS -2 Xrotation }\nMOTION\nFrames: 1\nFrame Time: 1\n0"
    )
    with pytest.raises(MotionError, match=r"a\.bvh: a joint has -2 channels"):
        read_bvh(tmp_path / "a.bvh")


@pytest.mark.parametrize("size", [(16384, 16384), (8192, 16384), (400, 400)])
def test_light_that_promises_more_than_it_holds(size: tuple[int, int], tmp_path: Path) -> None:
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % size
    (tmp_path / "a.hdr").write_bytes(head + bytes([2, 2, size[1] >> 8, size[1] & 255]) * 20)
    with pytest.raises(UikaError, match=r"a\.hdr: "):
        read_hdr(tmp_path / "a.hdr")


@pytest.mark.parametrize("rate", [1, 3])
def test_sound_of_a_few_samples_a_second(rate: int, tmp_path: Path) -> None:
    data = bytes(8000)
    head = struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 1, rate, 2 * rate, 2, 16)
    (tmp_path / "a.wav").write_bytes(
        b"RIFF" + struct.pack("<I", 8036) + b"WAVE" + head + b"data" + b"\x40\x1f\0\0" + data
    )
    with pytest.raises(UikaError, match=r"a\.wav: is longer than 10 minutes"):
        read_sound(tmp_path / "a.wav")
