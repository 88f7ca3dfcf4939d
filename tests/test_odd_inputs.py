"""Lines of the table of odd inputs in `docs/known-inputs.md`."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from tests.stress.outside_targets import _small_flame
from uika.assets import PORTRAIT
from uika.cli import main
from uika.errors import UikaError
from uika.head import HeadError
from uika.head_import import flame_file
from uika.io.files import replacing
from uika.io.sound import read_sound
from uika.motion import MotionError, read_bvh, read_csv, read_json
from uika.photo import PhotoError
from uika.photo.detect import find_face
from uika.photo.read import read
from uika.tracking.decode import VideoError, decode


@pytest.fixture(scope="module")
def portrait() -> Image.Image:
    return Image.open(PORTRAIT).convert("RGB")


STORED = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


@pytest.mark.parametrize("orientation", range(10))  # 0 and 9 mean nothing
def test_every_exif_orientation(orientation: int, portrait: Image.Image, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    wide = portrait.crop((0, 0, 400, 300))
    turn = STORED.get(orientation)
    (wide if turn is None else wide.transpose(turn)).save(tmp_path / "a.jpg", exif=exif, quality=95)
    found = read(tmp_path / "a.jpg").rgb
    assert found.shape == (300, 400, 3) and np.abs(found.astype(int) - np.asarray(wide)).mean() < 3


def deep_png(rgb: np.ndarray) -> bytes:
    height, width, _ = rgb.shape
    rows = b"".join(b"\0" + (row.astype(">u2") * 257).tobytes() for row in rgb)
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows)))
    body = (
        struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in (*chunks, (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


@pytest.mark.parametrize(
    "kind", ["16 bit", "CMYK", "animated WebP", "animated PNG", "two JPEGs in one", "HEIC as .jpg"]
)
def test_pictures_of_every_make_have_their_colours(kind: str, portrait: Image.Image, tmp_path: Path) -> None:
    path, black = tmp_path / "Портрет ü.jpg", Image.new("RGB", portrait.size)
    if kind == "16 bit":
        path.write_bytes(deep_png(np.asarray(portrait)))
    elif kind == "CMYK":
        portrait.convert("CMYK").save(path, "JPEG", quality=95)
    elif kind == "HEIC as .jpg":
        pytest.importorskip("pillow_heif").from_pillow(portrait).save(tmp_path / "a.heic", quality=95)
        (tmp_path / "a.heic").rename(path)
    else:
        form = {"animated WebP": "WEBP", "animated PNG": "PNG", "two JPEGs in one": "MPO"}[kind]
        portrait.save(path, form, save_all=True, append_images=[black], quality=95)
    assert np.abs(read(path).rgb.astype(int) - np.asarray(portrait)).mean() < 3


@pytest.mark.parametrize(
    ("start", "says"),
    [
        (b"GIF89a", "is a GIF"),
        (b"II*\0", "is a TIFF or a camera's raw file"),
        (b"\0\0\0\x1cftypavif", "is an AVIF file; save it as JPEG"),
        (b"\0\0\0\x0cJXL \r\n", "is a JPEG XL file"),
        (b"%PDF-1.7", "is a PDF"),
        (b"\n<svg xmlns=''/>", "is a drawing"),
        (b"<!DOCTYPE html>", "is a web page; download the photo itself"),
        (b"\0\0\0\x14ftypisom", "is a film; take a still of it"),
    ],
)
def test_what_is_no_photo_is_called_by_its_name(start: bytes, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(start + bytes(200))
    with pytest.raises(PhotoError, match=rf"a\.jpg: {says}"):
        read(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("name", "says"), [("https://example.org/me.jpg", "web address"), ("x" * 400, "name"), (".", "directory")]
)
def test_paths_that_are_no_files(name: str, says: str) -> None:
    with pytest.raises(PhotoError, match=says):
        read(name)


@pytest.mark.parametrize("upright", [True, False])
def test_a_small_face_in_a_panorama_is_found(upright: bool, portrait: Image.Image) -> None:
    size = (9000, 600) if upright else (560, 6000)
    wide = Image.new("RGB", size, (90, 120, 80))
    wide.paste(portrait, (6100, 40) if upright else (20, 3700))
    found, alone = find_face(np.asarray(wide)), find_face(np.asarray(portrait))
    assert found is not None and alone is not None
    assert np.linalg.norm(found - alone - ((6100, 40) if upright else (20, 3700)), axis=1).mean() < 3


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"jawOpen": "wide"}, "'jawOpen' is no number but 'wide' in frame 0"),
        ({"jawOpen": True}, "is no number but true or false"),
        ({"jawOpen": {"value": 0.5}}, "is no number but a group"),
        ({"jawOpen": "1_0"}, "is no number but '1_0'"),
        ({"fps": "fast", "frames": [{"jawOpen": 0.5}]}, "its frame rate is no number but 'fast'"),
        ({"names": ["jawOpen", "jawOpen"], "frames": [[0.1, 0.9]]}, "have 'jawOpen' twice"),
        ([{"jawOpen": 0.1, "headYaw": 30.0}], "headYaw is 30 in frame 0; angles are radians"),
    ],
)
def test_poses_whose_numbers_are_none(content: object, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(MotionError, match=rf"a\.json: .*{says}"):
        read_json(tmp_path / "a.json")


def test_numbers_in_quotes_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"jawOpen": "0.5"}')
    assert float(read_json(tmp_path / "a.json").expression.sum()) == 0.5


def test_a_name_twice_in_one_pose_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"jawOpen": 0.1, "jawOpen": 0.9}')
    with pytest.raises(MotionError, match=r"a\.json: names 'jawOpen' twice in one place"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("jawOpen,HeadYaw\n0.1,45\n", "headYaw is 45 in line 2; angles are radians"),
        ("jawOpen\n0_1\n", "jawOpen is '0_1'"),
        ("Prénom,jawOpen\n1,0.5\n", "no UTF-8 text"),
    ],
)
def test_tables_in_other_units_and_letters(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(MotionError, match=rf"a\.csv: .*{says}"):
        read_csv(tmp_path / "a.csv")


def test_a_nameless_column_of_row_numbers_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(",jawOpen\n0,0.5\n1,0.25\n")
    assert float(read_csv(tmp_path / "a.csv").expression.sum()) == 0.75


SKELETON = """HIERARCHY
ROOT Hips {{
OFFSET 0 0 0 CHANNELS 3 Zrotation Xrotation Yrotation
JOINT {name} {{ OFFSET 0 1 0 CHANNELS 3 Zrotation Xrotation Yrotation End Site {{ OFFSET 0 1 0 }} }} }}
MOTION
Frames:\t1
Frame Time:\t0.04
0 0 0 0 0 10
"""


@pytest.mark.parametrize("name", ["Head", "mixamorig:Head", "mixamorigHead", "Bip01 Head", "CC_Base_Head", "head_JNT"])
def test_heads_of_every_skeleton(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_bytes(SKELETON.format(name=name).replace("\n", "\r\n").encode())
    assert float(read_bvh(tmp_path / "a.bvh").neck[0, 1]) == pytest.approx(np.radians(10))


@pytest.mark.parametrize("name", ["Neck", "Head_End", "Bip01 HeadNub", "Forehead"])
def test_what_only_sounds_like_a_head(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(SKELETON.format(name=name))
    with pytest.raises(MotionError, match=r"a\.bvh: has no joint named as a head"):
        read_bvh(tmp_path / "a.bvh")


@pytest.fixture
def small_sizes(monkeypatch: pytest.MonkeyPatch) -> dict[str, np.ndarray]:
    for name in ("VERTICES", "IDENTITIES", "EXPRESSIONS"):
        monkeypatch.setattr(flame_file, name, getattr(flame_file, name))
    monkeypatch.setattr(flame_file, "_SHAPES", dict(flame_file._SHAPES))
    return _small_flame()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda a: {"v_template": np.where(a["v_template"] == 0, np.nan, a["v_template"])},
            "'v_template' does not hold",
        ),
        (lambda a: {"vt": np.full((6, 2), np.nan)}, "'uvs' holds values that are not finite"),
        (lambda a: {"vt": np.zeros(6)}, "'vt' has shape"),
        (lambda a: {"vt": np.array([["a", "b"]] * 6)}, "'vt' has shape"),
        (lambda a: {"f": a["f"] + 0.5}, "'f' is no table of triangles"),
        (lambda a: {"f": a["f"] + 10}, "'faces' points outside"),
        (lambda a: {"weights": 0 * a["weights"]}, "a vertex that no joint moves"),
        (lambda a: {"v_template": 1000 * a["v_template"]}, "FLAME's unit is the metre"),
        (lambda a: {"kintree_table": np.zeros((2, 3), np.int64)}, "'kintree_table' has shape"),
        (lambda a: {"kintree_table": np.full((2, 5), np.nan)}, "'kintree_table' does not hold whole numbers"),
    ],
)
def test_flame_models_that_cannot_be_right(change, says: str, small_sizes, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    np.savez(tmp_path / "good.npz", **small_sizes)
    assert flame_file.read_flame(tmp_path / "good.npz").id.startswith("flame-")
    np.savez(tmp_path / "bad.npz", **(small_sizes | change(small_sizes)))
    with pytest.raises(HeadError, match=rf"bad\.npz: .*{says}"):
        flame_file.read_flame(tmp_path / "bad.npz")


def test_flame_as_it_is_downloaded(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "FLAME2023.zip", "w") as archive:
        archive.writestr("flame2023.pkl", "x")
    with pytest.raises(HeadError, match=r"FLAME2023\.zip: is an archive; unpack it and give 'flame2023\.pkl'"):
        flame_file.read_flame(tmp_path / "FLAME2023.zip")


def test_lists_of_films_are_no_films(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode(None))
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile 'a.mp4'\n")
    with pytest.raises(VideoError, match=r"list\.mp4: .*is a list of other files"):
        list(decode(tmp_path / "list.mp4"))
    with pytest.raises(UikaError, match=r"list\.mp4: .*is a list of other files"):
        read_sound(tmp_path / "list.mp4")


def test_frames_with_notes_that_are_newer_than_pyav(portrait: Image.Image, tmp_path: Path) -> None:
    """Motion JPEG whose frames carry EXIF."""
    exif, stored = Image.Exif(), io.BytesIO()
    exif[0x0112] = 6
    wide = portrait.crop((0, 0, 400, 300))
    wide.transpose(Image.Transpose.ROTATE_90).save(stored, "JPEG", exif=exif, quality=95)
    (tmp_path / "a.jpg").write_bytes(stored.getvalue())
    (frame,) = decode(tmp_path / "a.jpg", colour=True)
    assert frame.rgb.shape == (300, 400, 3)
    assert np.abs(frame.rgb.astype(int) - np.asarray(wide)).mean() < 5


def test_places_where_nothing_can_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UikaError, match=r"file/a\.png: cannot be written"), replacing(tmp_path / "file" / "a.png"):
        pass
    assert main(["render", "me.safetensors", "-o", str(tmp_path)]) == 2
    assert "is a directory; give the name of a .png file" in " ".join(capsys.readouterr().err.split())
