import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from uika.photo import PhotoError, prepare
from uika.photo.read import MAX_PIXELS, read


@pytest.fixture(scope="module")
def upright(portrait_path: Path) -> Image.Image:
    return Image.open(portrait_path).convert("RGB").resize((256, 256))


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(width: int, height: int, depth: int, colour: int, rows: bytes) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def png16(pixels: np.ndarray) -> bytes:
    height, width = pixels.shape[:2]
    rows = pixels.astype(">u2").reshape(height, -1)
    return png(width, height, 16, 0 if pixels.ndim == 2 else 2, b"".join(b"\0" + row.tobytes() for row in rows))


def assert_refused(path: Path, words: str) -> None:
    with pytest.raises(PhotoError, match=words) as caught:
        prepare(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert caught.value.path == str(path)


def test_missing(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none.jpg", "does not exist")


def test_directory(tmp_path: Path) -> None:
    assert_refused(tmp_path, "is a directory")


def test_empty(tmp_path: Path) -> None:
    path = tmp_path / "empty.jpg"
    path.touch()
    assert_refused(path, "is empty")


def test_not_a_photo(tmp_path: Path) -> None:
    path = tmp_path / "notes.jpg"
    path.write_text("these are words, no picture\n" * 20)
    assert_refused(path, "not a readable photo")


def test_format_not_offered(tmp_path: Path, upright: Image.Image) -> None:
    path = tmp_path / "photo.png"
    upright.save(path, format="GIF")
    assert_refused(path, "JPEG, PNG, WebP or HEIC")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_truncated(tmp_path: Path, upright: Image.Image, kind: str) -> None:
    path = tmp_path / "cut"
    upright.save(path, format=kind)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert_refused(path, "damaged or cut short")


@pytest.mark.parametrize("side", [9_000, 20_000, 100_000])
def test_too_many_pixels_are_refused_from_the_header(tmp_path: Path, side: int) -> None:
    path = tmp_path / "huge.png"
    path.write_bytes(png(side, side, 8, 2, b""))
    assert_refused(path, f"more than(.*) {MAX_PIXELS // 10**6} megapixels")


def test_too_few_pixels(tmp_path: Path, upright: Image.Image) -> None:
    path = tmp_path / "small.png"
    upright.resize((8, 8)).save(path)
    assert_refused(path, "only 8x8 px")


def test_plain_rgb_is_exact(tmp_path: Path, upright: Image.Image) -> None:
    path = tmp_path / "plain.png"
    upright.save(path)
    picture = read(path)
    assert picture.alpha is None
    assert len(picture.sha256) == 64
    np.testing.assert_array_equal(picture.rgb, np.asarray(upright))


@pytest.mark.parametrize("kind,worst", [("JPEG", 4.0), ("WEBP", 4.0), ("HEIF", 4.0)])
def test_lossy_formats_are_close(tmp_path: Path, upright: Image.Image, kind: str, worst: float) -> None:
    if kind == "HEIF":
        pytest.importorskip("pillow_heif").register_heif_opener()
    path = tmp_path / "photo"
    upright.save(path, format=kind, quality=95)
    assert np.abs(read(path).rgb - np.asarray(upright, dtype=float)).mean() < worst


def test_cmyk_is_close(tmp_path: Path, upright: Image.Image) -> None:
    path = tmp_path / "photo.jpg"
    upright.convert("CMYK").save(path, quality=95)
    assert np.abs(read(path).rgb - np.asarray(upright, dtype=float)).mean() < 4


def test_grey_and_palette(tmp_path: Path, upright: Image.Image) -> None:
    grey, palette = tmp_path / "grey.png", tmp_path / "palette.png"
    upright.convert("L").save(grey)
    upright.quantize(64).save(palette)
    np.testing.assert_array_equal(read(grey).rgb, np.asarray(upright.convert("L").convert("RGB")))
    np.testing.assert_array_equal(read(palette).rgb, np.asarray(upright.quantize(64).convert("RGB")))


def test_palette_with_transparency_does_not_warn(tmp_path: Path, upright: Image.Image) -> None:
    path = tmp_path / "palette.png"
    upright.quantize(64).save(path, transparency=bytes([0, 128] + [255] * 62))
    alpha = read(path).alpha
    assert alpha is not None
    assert {0, 128, 255} >= set(np.unique(alpha)) > {255}


@pytest.mark.parametrize("grey", [True, False])
def test_sixteen_bits(tmp_path: Path, upright: Image.Image, grey: bool) -> None:
    path = tmp_path / "deep.png"
    pixels = np.asarray(upright.convert("L") if grey else upright)
    path.write_bytes(png16(pixels.astype(np.uint16) * 257))
    rgb = read(path).rgb
    np.testing.assert_array_equal(rgb, pixels[..., None].repeat(3, axis=2) if grey else pixels)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path: Path, upright: Image.Image, orientation: int) -> None:
    stored = {
        1: None,
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }[orientation]
    wide = upright.crop((0, 20, 256, 220))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "turned.png"
    (wide if stored is None else wide.transpose(stored)).save(path, exif=exif)
    np.testing.assert_array_equal(read(path).rgb, np.asarray(wide))


def test_transparency_is_returned(tmp_path: Path, upright: Image.Image) -> None:
    alpha = Image.linear_gradient("L")
    photo = upright.copy()
    photo.putalpha(alpha)
    photo.save(tmp_path / "cut.png")
    picture = read(tmp_path / "cut.png")
    np.testing.assert_array_equal(picture.alpha, np.asarray(alpha))
    np.testing.assert_array_equal(picture.rgb, np.asarray(upright))


def test_opaque_alpha_is_no_matte(tmp_path: Path, upright: Image.Image) -> None:
    upright.convert("RGBA").save(tmp_path / "opaque.png")
    assert read(tmp_path / "opaque.png").alpha is None


def test_colour_profile_is_applied(tmp_path: Path) -> None:
    """A profile whose red and blue are swapped must swap them back; sRGB's own profile must change nothing."""
    from PIL import ImageCms

    plain = Image.new("RGB", (64, 64), (200, 90, 40))
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    plain.save(tmp_path / "srgb.png", icc_profile=bytes(profile))
    at = [profile.index(tag, 128) for tag in (b"rXYZ", b"bXYZ")]
    profile[at[0] : at[0] + 4], profile[at[1] : at[1] + 4] = b"bXYZ", b"rXYZ"
    plain.save(tmp_path / "swapped.png", icc_profile=bytes(profile))
    assert np.abs(read(tmp_path / "srgb.png").rgb[0, 0] - np.array([200.0, 90, 40])).max() <= 1
    assert np.abs(read(tmp_path / "swapped.png").rgb[0, 0] - np.array([40.0, 90, 200])).max() <= 2


def test_damaged_colour_profile_is_ignored(tmp_path: Path) -> None:
    plain = Image.new("RGB", (64, 64), (200, 90, 40))
    plain.save(tmp_path / "odd.png", icc_profile=b"no profile at all")
    assert tuple(read(tmp_path / "odd.png").rgb[0, 0]) == (200, 90, 40)


@pytest.mark.parametrize("kind", ["AVIF", "GIF", "TIFF"])
def test_kinds_that_are_not_read_are_said_to_be_none(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind.lower()}"
    try:
        Image.new("RGB", (96, 96), (10, 90, 30)).save(path, kind)
    except (KeyError, OSError):
        pytest.skip(f"skipped: this Pillow writes no {kind}")
    with pytest.raises(PhotoError, match=rf"is an? {kind}.*; save it as JPEG, PNG, WebP or HEIC"):
        read(path)
