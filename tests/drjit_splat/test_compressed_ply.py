"""PlayCanvas's compressed `.ply`: another library's file is read, and unusable ones are named."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from drjit_splat import load_ply, load_splats

from .test_spz import made_up

COUNT, DEGREE = 600, 2  # of the recorded file, made by tools/record_splats.py: three chunks, the last not full
RECORDED = Path(__file__).with_name("recorded") / "gsply.compressed.ply"


def chunk_width(values: torch.Tensor, steps: int) -> torch.Tensor:
    """Half a step of each splat's chunk: as near as the format's bits allow."""
    parts = [part.amax(0) - part.amin(0) for part in values.split(256)]
    return torch.cat([p.expand(len(v), -1) for p, v in zip(parts, values.split(256), strict=True)]) / steps / 2


def test_another_librarys_file_is_read() -> None:
    found, expected = load_ply(RECORDED), made_up(COUNT, DEGREE)
    assert torch.equal(load_splats(RECORDED).means, found.means)
    steps = torch.tensor([2047.0, 1023, 2047])
    for got, wanted in ((found.means, expected.means), (found.scales.log(), expected.scales.log())):
        assert bool(((got - wanted).abs() <= chunk_width(wanted, 1) / steps * 1.001 + 1e-6).all())
    assert float((found.quats * expected.quats).sum(-1).abs().min()) > 1 - 2e-6
    assert float((found.opacities - expected.opacities).abs().max()) < 0.5 / 255 + 1e-6
    colors, wanted = found.colors, expected.colors
    assert bool(((colors - wanted).abs() <= chunk_width(wanted, 255) * 1.001 + 1e-6).all())
    assert found.degree == DEGREE
    torch.testing.assert_close(found.harmonics[:, 1:], expected.harmonics[:, 1:], atol=4 / 255 + 1e-3, rtol=0)


def with_bits(rotation: int, position: int = 0, color: int = 0, chunk_colors: bool = False) -> bytes:
    """A file of one splat between -1 and 1, scales between e^-2 and e^0."""
    names = [f"{end}_{c}" for end in ("min", "max") for c in "xyz"]
    names += [f"{end}_scale_{c}" for end in ("min", "max") for c in "xyz"]
    values = [-1.0] * 3 + [1.0] * 3 + [-2.0] * 3 + [0.0] * 3
    if chunk_colors:
        names += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"]
        values += [0.25] * 3 + [0.75] * 3
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {n}" for n in names)]
    lines += ["element vertex 1", *(f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color"))]
    body = np.array(values, "<f4").tobytes() + np.array([position, rotation, 2**32 - 1, color], "<u4").tobytes()
    return "\n".join([*lines, "end_header", ""]).encode() + body


@pytest.mark.parametrize("largest", range(4))
def test_each_bit_has_its_place(tmp_path: Path, largest: int) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(with_bits(largest << 30 | 1023 << 20 | 0 << 10 | 512, 2047 << 21 | 2047, 0xFF008040))
    found = load_ply(path)
    torch.testing.assert_close(found.means, torch.tensor([[1.0, -1.0, 1.0]]))
    torch.testing.assert_close(found.scales, torch.ones(1, 3))
    torch.testing.assert_close(found.opacities, torch.tensor([64 / 255]))
    torch.testing.assert_close(found.colors, torch.tensor([[1.0, 0.0, 128 / 255]]))
    others = [0.5**0.5, -(0.5**0.5), 2**0.5 * (512 / 1023 - 0.5)]
    wanted = [*others[:largest], 0.0, *others[largest:]]
    torch.testing.assert_close(found.quats, torch.tensor([wanted]), atol=1e-3, rtol=0)
    path.write_bytes(with_bits(0, 0, 0xFF000000, chunk_colors=True))
    torch.testing.assert_close(load_ply(path).colors, torch.tensor([[0.75, 0.25, 0.25]]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element chunk 3", b"element chunk 2", "2 chunks for 600 splats; 3 were expected"),
        (b"element vertex 600", b"element vertex 601", "harmonics for 601 splats|cut short"),
        (b"element vertex 600", b"element vertex 99999999999", "chunks for"),
        (b"uint packed_scale", b"float packed_scale", "no property 'packed_scale'"),
        (b"uint packed_color", b"uint something", "no property 'packed_color'"),
        (b"property float max_scale_z\n", b"", "no property 'max_scale_z'"),
        (b"property float min_g\n", b"", "no property 'min_g'"),
        (b"property uchar f_rest_3\n", b"", "23 harmonics"),
        (b"property uchar f_rest_3\n", b"property float f_rest_3\n", "24 harmonics"),
        (b"element sh 600", b"element sh 599", "599 rows"),
        (b"element sh", b"element shoes", "unknown layout"),
        (b"binary_little_endian", b"ascii", "unknown layout"),
        (b"property uchar f_rest_3\n", b"property list uchar int f_rest_3\n", "24 harmonics"),
    ],
)
def test_another_layout_is_named(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    whole, path = RECORDED.read_bytes(), tmp_path / "bad.ply"
    assert old in whole
    path.write_bytes(whole.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as refused:
        load_ply(path)
    assert re.match(re.escape(str(path)), str(refused.value))


def test_a_cut_file_and_one_with_a_nan_are_named(tmp_path: Path) -> None:
    whole, path = RECORDED.read_bytes(), tmp_path / "bad.ply"
    path.write_bytes(whole[:-1])
    with pytest.raises(ValueError, match="cut short"):
        load_ply(path)
    at = whole.index(b"end_header\n") + 11
    path.write_bytes(whole[:at] + np.float32("nan").tobytes() + whole[at + 4 :])
    with pytest.raises(ValueError, match=r"bad\.ply: means\[\d+, 0\] is nan"):
        load_ply(path)
