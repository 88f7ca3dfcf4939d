"""Lines of `docs/known-inputs.md` that no other test holds."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from drjit_splat import load_ply, save_ply
from uika.head import HeadError
from uika.head_import.flame_file import read_flame
from uika.motion import MotionError, read_csv, read_json
from uika.photo.read import read
from uika.tracking.decode import decode, frame_rate
from uika.tracking.track import _pace


def test_raw_h264_without_a_rate_plays_at_25(tmp_path: Path) -> None:
    path = tmp_path / "raw.h264"
    with av.open(str(path), "w", format="h264") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        for level in range(4):
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24"))
            )
        container.mux(stream.encode(None))
    assert len(list(decode(path))) == 4 and frame_rate(path) == 25
    for times in ([None] * 4, [0.0, None, 0.2, 0.9], [0.3, 0.2, 0.1, 0.0], [0.0] * 4):
        assert _pace(path, times) == (25.0, None)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_heic_orientations_are_applied_once(orientation: int, tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    image = Image.new("RGB", (160, 96), (20, 20, 20))
    image.paste((230, 30, 30), (0, 0, 80, 48))
    exif = Image.Exif()
    exif[0x0112] = orientation
    heif.from_pillow(image).save(tmp_path / "a.heic", exif=exif.tobytes(), quality=95)
    found = read(tmp_path / "a.heic").rgb
    turns = {1: 0, 3: 2, 6: 3, 8: 1}[orientation]
    want = np.rot90(np.asarray(image), turns)
    assert found.shape == want.shape and np.abs(found.astype(int) - want).mean() < 6


@pytest.mark.parametrize("depth", ["RGB;10", "RGB;12", "RGB;16"])
def test_heic_of_more_than_8_bits(depth: str, tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    values = np.full((96, 96, 3), (1 << int(depth[4:])) // 2, np.uint16)
    heif.encode(depth, (96, 96), values.tobytes(), str(tmp_path / "a.heic"), quality=90)
    assert abs(float(read(tmp_path / "a.heic").rgb.mean()) - 128) < 3


def splats(path: Path) -> bytes:
    torch.manual_seed(0)
    save_ply(path, torch.rand(3, 3), torch.rand(3, 4), torch.rand(3, 3), torch.rand(3), torch.rand(3, 3))
    return path.read_bytes()


def change_header(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    def changed(data: bytes) -> bytes:
        end = data.index(b"end_header\n") + 11
        return change(data[:end]) + data[end:]

    return changed


@pytest.mark.parametrize(
    "change",
    [
        change_header(lambda h: h.replace(b"\n", b"\r\n")),
        change_header(lambda h: h.replace(b"element", b"comment made elsewhere\nobj_info splats\nelement", 1)),
        change_header(lambda h: h.replace(b"float x", b"float32 x").replace(b"float y", b"float32 y")),
    ],
)
def test_headers_of_other_programs(change: Callable[[bytes], bytes], tmp_path: Path) -> None:
    good = splats(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(change(good))
    assert torch.equal(load_ply(tmp_path / "b.ply").means, load_ply(tmp_path / "a.ply").means)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_places_that_are_no_numbers_are_named(value: float, tmp_path: Path) -> None:
    data = splats(tmp_path / "a.ply")
    start = data.index(b"end_header\n") + 11
    (tmp_path / "b.ply").write_bytes(data[:start] + struct.pack("<f", value) + data[start + 4 :])
    with pytest.raises(ValueError, match=r"b\.ply: means\[0, 0\]"):
        load_ply(tmp_path / "b.ply")


def test_a_scale_of_minus_infinity_is_size_0(tmp_path: Path) -> None:
    data = bytearray(splats(tmp_path / "a.ply"))
    start = data.index(b"end_header\n") + 11
    names = [line.split()[2] for line in bytes(data[:start]).splitlines() if line.startswith(b"property")]
    place = start + 4 * names.index(b"scale_0")
    data[place : place + 4] = struct.pack("<f", float("-inf"))
    (tmp_path / "b.ply").write_bytes(data)
    assert float(load_ply(tmp_path / "b.ply").scales[0, 0]) == 0


def test_a_mesh_is_no_splat_file(tmp_path: Path) -> None:
    head = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {axis}" for axis in "xyz")]
    more = ["element face 1", "property list uchar int vertex_indices", "end_header", "0 0 0", "3 0 0 0", ""]
    (tmp_path / "mesh.ply").write_text("\n".join(head + more))
    with pytest.raises(ValueError, match=r"mesh\.ply has no property 'f_dc_0'; is it a splat file\?"):
        load_ply(tmp_path / "mesh.ply")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("Timecode,BlendshapeCount,JawOpen\n", "has no rows below its names"),
        ("0.1,0.2,0.3\n0.1,0.2,0.3\n", "names no ARKit actions"),
        ("\n\n", "the file is empty"),
    ],
)
def test_tables_without_content_say_so(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(MotionError, match=rf"a\.csv: .*{says}"):
        read_csv(tmp_path / "a.csv")


@pytest.mark.parametrize(("name", "meant"), [("eyeWidenLeft", "eyeWideLeft"), ("noseSnearRight", "noseSneerRight"),
                                             ("browDownLft", "browDownLeft")])  # fmt: skip
def test_near_misses_are_guessed(name: str, meant: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps([{name: 0.5, "jawOpen": 0.1}]))
    with pytest.raises(MotionError, match=rf"'{name}' \(meant {meant}\?\)"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("rate", [24, 25, 30, 60])
def test_timecodes_count_frames_of_their_own_rate(rate: int, tmp_path: Path) -> None:
    rows = "".join(f"00:00:{k // rate:02d}:{k % rate:02d}.0,52,0.1\n" for k in range(4 * rate))
    (tmp_path / "a.csv").write_text("Timecode,BlendshapeCount,JawOpen\n" + rows)
    found = read_csv(tmp_path / "a.csv")
    assert (found.fps, len(found)) == (rate, 4 * rate)


@pytest.mark.parametrize("data", [b"\x80\x02}q\x00X\x05\x00", b"\x80\x04\x95\xff\xff", b""])
def test_cut_models_are_named(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "m.pkl").write_bytes(data)
    with pytest.raises(HeadError, match=r"m\.pkl: is damaged or no pickle"):
        read_flame(tmp_path / "m.pkl")
