"""`.spz` files of another library are read, ours keep what the format can say, and damaged ones are named."""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import pytest
import torch

from drjit_splat import SplatFile, load_spz, save_spz
from drjit_splat._harmonics import basis
from drjit_splat.spz import _SH_SIGNS

RECORDED = Path(__file__).with_name("recorded")
SIGNS = torch.from_numpy(_SH_SIGNS)[:, None]


def made_up(count: int = 30, degree: int = 3) -> SplatFile:
    random = torch.Generator().manual_seed(11)
    higher = (degree + 1) ** 2 - 1
    return SplatFile(
        3 * torch.randn(count, 3, generator=random),
        torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=-1),
        (torch.randn(count, 3, generator=random) - 3).exp(),
        torch.rand(count, generator=random).clamp(0.01, 0.99),
        torch.cat(
            (torch.randn(count, 1, 3, generator=random), 1.6 * torch.rand(count, higher, 3, generator=random) - 0.8), 1
        ),
    )


def assert_near(found: SplatFile, expected: SplatFile) -> None:
    """As near as the format's bits allow."""
    torch.testing.assert_close(found.means, expected.means, atol=0.5 / 4096 + 1e-6, rtol=0)
    torch.testing.assert_close(found.scales.log(), expected.scales.log(), atol=0.5 / 16 + 1e-4, rtol=0)
    torch.testing.assert_close(found.opacities, expected.opacities, atol=0.5 / 255 + 1e-4, rtol=0)
    alike = (found.quats * expected.quats).sum(-1).abs()
    assert alike.min() > 1 - 1e-5
    torch.testing.assert_close(found.harmonics[:, 0], expected.harmonics[:, 0].clamp(-3.33, 3.33), atol=0.014, rtol=0)
    torch.testing.assert_close(found.harmonics[:, 1:4], expected.harmonics[:, 1:4], atol=5 / 128, rtol=0)
    torch.testing.assert_close(found.harmonics[:, 4:], expected.harmonics[:, 4:], atol=9 / 128, rtol=0)


@pytest.mark.parametrize("version", [3, 4])
def test_another_librarys_files_are_read(version: int) -> None:
    found, expected = load_spz(RECORDED / f"gsply_{version}.spz"), made_up()
    # The library does not turn the axes: what it wrote as harmonics of its axes comes out with other signs here.
    harmonics = torch.cat((found.harmonics[:, :1], found.harmonics[:, 1:] * SIGNS), 1)
    assert_near(SplatFile(found.means, found.quats, found.scales, found.opacities, harmonics), expected)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_back(tmp_path: Path, degree: int) -> None:
    splats = made_up(degree=degree)
    save_spz(tmp_path / "a.spz", *vars(splats).values())
    assert_near(load_spz(tmp_path / "a.spz"), splats)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"]


def test_harmonics_keep_their_colours_when_axes_are_turned() -> None:
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    turned = basis(directions * torch.tensor([1.0, -1.0, -1.0]), 3)[:, 1:]
    torch.testing.assert_close(turned, basis(directions, 3)[:, 1:] * SIGNS[:, 0])


def test_large_scenes_keep_fewer_digits(tmp_path: Path) -> None:
    splats = made_up()
    far = splats.means * 1e4
    save_spz(tmp_path / "far.spz", far, *list(vars(splats).values())[1:])
    torch.testing.assert_close(load_spz(tmp_path / "far.spz").means, far, atol=far.abs().max().item() * 2**-22, rtol=0)
    with pytest.raises(ValueError, match="farther away"):
        save_spz(tmp_path / "far.spz", splats.means * 1e8, *list(vars(splats).values())[1:])


def test_version_2_keeps_three_components(tmp_path: Path) -> None:
    header = b"NGSP" + struct.pack("<IIBBBB", 2, 1, 0, 12, 0, 0)
    body = b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1.5, -2.0, 0.25))
    body += bytes([204]) + bytes([128, 128, 128]) + bytes([80, 96, 112]) + bytes([128, 217, 128])
    (tmp_path / "two.spz").write_bytes(gzip.compress(header + body))
    found = load_spz(tmp_path / "two.spz")
    torch.testing.assert_close(found.means[0], torch.tensor([1.5, 2.0, -0.25]))
    torch.testing.assert_close(found.opacities, torch.tensor([0.8]))
    torch.testing.assert_close(found.scales[0].log(), torch.tensor([-5.0, -4.0, -3.0]))
    torch.testing.assert_close(found.quats[0], torch.tensor([0.712, 0.004, -0.702, -0.004]), atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is no .spz file"),
        (b"ply\n", "is no .spz file"),
        (gzip.compress(b"NGSX" + bytes(40)), "is no .spz file"),
        (gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 9, 1, 0, 12, 0, 0)), "version 9"),
        (gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, 900_000, 3, 12, 0, 0) + bytes(99)), "cut short"),
        (gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, 2**31, 3, 12, 0, 0)), "at most"),
        (gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, 1, 7, 12, 0, 0)), "degree 7"),
        (gzip.compress(b"NGSP" + bytes(60))[:-20], "version 0|damaged|cut short"),
        (b"NGSP" + struct.pack("<IIBBBBI", 4, 3, 0, 12, 0, 6, 32) + bytes(12), "table does not fit"),
        (b"NGSP" + struct.pack("<II", 4, 3), "cut short"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.spz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as refused:
        load_spz(path)
    assert "bad.spz" in str(refused.value)


@pytest.mark.parametrize("version", [3, 4])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, version: int) -> None:
    count = 10_000_000
    if version == 3:
        packer = zlib.compressobj(9, wbits=31)
        data = (
            packer.compress(b"NGSP" + struct.pack("<IIBBBB", 3, count, 3, 12, 0, 0) + bytes(1 << 16)) + packer.flush()
        )
    else:
        table = b"".join(struct.pack("<QQ", 20, count * each) for each in (9, 1, 3, 3, 4, 45))
        data = b"NGSP" + struct.pack("<IIBBBBI", 4, count, 3, 12, 0, 6, 32) + bytes(12) + table + bytes(120)
    (tmp_path / "bomb.spz").write_bytes(data)
    with pytest.raises(ValueError, match=r"bomb\.spz says 10,000,000 splats, 650,000,000 bytes in"):
        load_spz(tmp_path / "bomb.spz")


def test_every_cut_and_every_flipped_byte_ends_in_a_sentence_or_splats(tmp_path: Path) -> None:
    for version in (3, 4):
        whole = (RECORDED / f"gsply_{version}.spz").read_bytes()
        for at in range(0, len(whole), 37):
            for content in (whole[:at], whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]):
                (tmp_path / "cut.spz").write_bytes(content)
                try:
                    load_spz(tmp_path / "cut.spz")
                except ValueError as error:
                    assert "cut.spz" in str(error)
