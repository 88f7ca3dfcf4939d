"""Radiance pictures are read, or refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest

from uika.errors import UikaError
from uika.io.radiance_hdr import read_hdr

HEADER = b"#?RADIANCE\n# made up\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n"


def plain(rows: int, columns: int) -> np.ndarray:
    pixels = np.random.default_rng(0).integers(1, 255, (rows, columns, 4)).astype(np.uint8)
    pixels[..., 3] = 128 + pixels[..., 3] % 4
    return pixels


def coded(pixels: np.ndarray) -> bytes:
    rows, columns = pixels.shape[:2]
    result = b""
    for row in range(rows):
        result += bytes([2, 2, columns >> 8, columns & 255])
        for channel in range(4):
            line = pixels[row, :, channel].tobytes()
            if len(set(line)) == 1:
                result += bytes([128 + columns, line[0]])
            else:
                result += bytes([columns]) + line
    return result


def level(pixels: np.ndarray) -> np.ndarray:
    return pixels[..., :3] * 2.0 ** (pixels[..., 3:].astype(float) - 136)


def test_plain_and_coded_pictures_hold_the_same(tmp_path: Path) -> None:
    pixels = plain(5, 12)
    pixels[2] = (100, 50, 25, 129)
    (tmp_path / "plain.hdr").write_bytes(HEADER % (5, 12) + pixels.tobytes())
    (tmp_path / "coded.hdr").write_bytes(HEADER % (5, 12) + coded(pixels))
    for name in ("plain.hdr", "coded.hdr"):
        np.testing.assert_allclose(read_hdr(tmp_path / name), level(pixels), rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "not a Radiance"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 4 +X 8\n", "not a Radiance"),
        (HEADER % (4, 99999), "16384"),
        (HEADER % (4, 12) + b"\x01" * 9, "cut short"),
        (HEADER % (4, 12) + coded(plain(4, 12))[:-3], "cut short"),
        (HEADER % (4, 12) + bytes([2, 2, 0, 12, 0, 0]), "cut short"),
    ],
)
def test_other_files_are_refused_by_name(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / "room.hdr"
    path.write_bytes(content)
    with pytest.raises(UikaError, match=r"room\.hdr") as refusal:
        read_hdr(path)
    assert word in str(refusal.value)
