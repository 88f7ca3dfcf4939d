"""The focal length in a photo's EXIF."""

from pathlib import Path

import pytest
from PIL import Image

from uika.photo import prepare
from uika.photo.read import read

EXIF = 0x8769


def save(path: Path, size: tuple[int, int], focal: object = None, noted: tuple[object, object] | None = None) -> Path:
    exif = Image.Exif()
    entries = exif.get_ifd(EXIF)
    if focal is not None:
        entries[0xA405] = focal
    if noted is not None:
        entries[0xA002], entries[0xA003] = noted
    Image.new("RGB", size, "grey").save(
        path, exif=exif.tobytes()
    )  # a PNG would leave out an object without main entries
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "heic"])
def test_equivalent_focal_lengths_compare_diagonals(tmp_path: Path, suffix: str) -> None:
    if suffix == "heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    # A phone's main camera: 26 mm equivalent, 4032 x 3024 pixels, scaled to a tenth.
    found = read(save(tmp_path / f"a.{suffix}", (403, 302), 26, (4032, 3024))).focal
    assert found == pytest.approx(26 / 43.27 * 503.6, rel=1e-3)
    assert read(save(tmp_path / f"b.{suffix}", (302, 403), 26)).focal == pytest.approx(found, rel=1e-3)


@pytest.mark.parametrize(
    ("size", "focal", "noted"),
    [
        ((300, 300), 26, (4032, 3024)),  # cropped
        ((300, 300), 26, None),
        ((400, 300), None, None),
        ((400, 300), 0, None),
        ((400, 300), 5000, None),
    ],
)
def test_a_cropped_photo_tells_nothing(
    tmp_path: Path, size: tuple[int, int], focal: object, noted: tuple[object, object] | None
) -> None:
    assert read(save(tmp_path / "a.jpg", size, focal, noted)).focal is None


def test_damaged_entries_leave_the_pixels(tmp_path: Path) -> None:
    path = save(tmp_path / "a.jpg", (400, 300), 26, (4032, 3024))
    data = bytearray(path.read_bytes())
    start = data.index(b"Exif")
    for place in range(start + 6, start - 2 + int.from_bytes(data[start - 2 : start], "big")):
        broken = data.copy()
        broken[place] = 0xFF
        path.write_bytes(broken)
        focal = read(path).focal
        assert focal is None or focal > 0


def test_the_crop_sees_through_the_same_lens(portrait_path: Path, tmp_path: Path) -> None:
    picture = Image.open(portrait_path).convert("RGB")
    exif = Image.Exif()
    exif.get_ifd(EXIF).update({0xA405: 50, 0xA002: picture.width, 0xA003: picture.height})
    picture.save(tmp_path / "a.png", exif=exif.tobytes())
    photo = prepare(tmp_path / "a.png", 256)
    whole = read(tmp_path / "a.png").focal
    assert photo.focal is not None and whole is not None
    assert photo.focal == pytest.approx(whole * 256 / photo.crop[2])
    assert prepare(portrait_path, 256).focal is None
