"""Splat files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from drjit_splat import load_ply, save_ply

from .common import random_scene


def splats(count: int = 40, harmonics: int = 1) -> dict[str, torch.Tensor]:
    scene = random_scene(count=count)
    scene["colors"] = torch.randn(count, harmonics, 3, generator=torch.Generator().manual_seed(1))
    return {k: scene[k] for k in ("means", "quats", "scales", "opacities", "colors")}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path: Path, degree: int) -> None:
    given = splats(harmonics=(degree + 1) ** 2)
    path = tmp_path / "a.ply"
    save_ply(path, **given)
    found = load_ply(path)
    assert found.degree == degree
    assert torch.equal(found.means, given["means"])
    assert torch.equal(found.quats, given["quats"])
    assert torch.equal(found.harmonics, given["colors"])
    assert torch.allclose(found.scales, given["scales"], rtol=1e-6)
    assert torch.allclose(found.opacities, given["opacities"], atol=1e-6)


def test_layout_is_the_one_that_viewers_expect(tmp_path: Path) -> None:
    given = splats(count=3, harmonics=4)
    path = tmp_path / "a.ply"
    save_ply(path, **given)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:18] == [f"f_rest_{i}" for i in range(9)]
    assert names[18:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    row = np.frombuffer(body, "<f4").reshape(3, -1)[1]
    assert row[9:12].tolist() == given["colors"][1, 1:, 0].tolist()  # all of red before any of green
    assert row[names.index("opacity")] == pytest.approx(float(torch.logit(given["opacities"][1])), rel=1e-5)


def test_plain_colors_become_the_constant_harmonic(tmp_path: Path) -> None:
    given = splats() | {"colors": torch.rand(40, 3, generator=torch.Generator().manual_seed(2))}
    save_ply(tmp_path / "a.ply", **given)
    assert torch.allclose(load_ply(tmp_path / "a.ply").colors, given["colors"], atol=1e-6)


def test_no_splats_and_extremes(tmp_path: Path) -> None:
    given = splats(count=2)
    given["opacities"], given["scales"] = torch.tensor([0.0, 1.0]), torch.zeros(2, 3)
    save_ply(tmp_path / "a.ply", **given)
    assert load_ply(tmp_path / "a.ply").opacities.tolist() == pytest.approx([0, 1], abs=1e-5)
    save_ply(tmp_path / "b.ply", **{k: v[:0] for k, v in given.items()})
    assert len(load_ply(tmp_path / "b.ply").means) == 0


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    save_ply(path, **splats())
    whole = path.read_bytes()
    cases = {
        "cut short": whole[:-5],
        "is not a .ply file": b"solid" + whole,
        "no property 'opacity'": whole.replace(b"float opacity", b"float opacitx"),
        "0, 9, 24 or 45": whole.replace(b"property float nx", b"property float f_rest_0"),
        "of none of the formats": whole.replace(b"binary_little_endian", b"binary_pdp_endian"),
        "has a word": whole.split(b"format")[0]
        + b"format ascii 1.0"
        + whole[whole.index(b"1.0") + 3 : whole.index(b"end_header") + 11]
        + b"one " * 680,
        "element vertex": whole.replace(b"element vertex 40", b"element vertex -4"),
        "cannot be read": whole.replace(b"property float nx", b"property list uchar int nx"),
        "twice": whole.replace(b"property float nx", b"property float x"),
        "means": whole[: whole.index(b"end_header") + 11]
        + b"\x00\x00\xc0\x7f"
        + whole[whole.index(b"end_header") + 15 :],
    }
    for message, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(ValueError, match=message):
            load_ply(path)
    # A header that promises more than the file holds must not allocate it.
    path.write_bytes(whole.replace(b"element vertex 40", b"element vertex " + b"9" * 5000))
    with pytest.raises(ValueError, match=r"a\.ply has an element without"):
        load_ply(path)
    path.write_bytes(whole.replace(b"element vertex 40", b"element vertex 4000000000000"))
    with pytest.raises(ValueError, match="cut short"):
        load_ply(path)
    with pytest.raises(FileNotFoundError):
        load_ply(tmp_path / "none.ply")


def test_text_big_endian_and_further_elements_are_read(tmp_path: Path) -> None:
    given = splats(harmonics=4)
    path = tmp_path / "a.ply"
    save_ply(path, **given, extra={"binding_0": torch.arange(40.0)}, comments=["made by\nümlaut"])
    header, body = path.read_bytes().split(b"end_header\n", 1)
    assert b"comment made by??mlaut\n" in header
    rows = np.frombuffer(body, "<f4").reshape(40, -1)
    assert rows[:, -1].tolist() == list(range(40))
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows).encode()
    more = header + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    others = {
        "ascii": more.replace(b"binary_little_endian", b"ascii") + text + b"\n3 0 1 2\n",
        "binary_big_endian": more.replace(b"little", b"big") + rows.astype(">f4").tobytes() + b"\x03" + b"\0" * 12,
        "carriage returns": (header + b"end_header\n").replace(b"\n", b"\r\n") + body,
    }
    for name, data in others.items():
        (tmp_path / "b.ply").write_bytes(data)
        found = load_ply(tmp_path / "b.ply")
        for key, value in vars(load_ply(path)).items():
            assert torch.equal(value, vars(found)[key]), (name, key)


def test_interrupted_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    save_ply(path, **splats())
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"^binding_0 must have the shape"):
        save_ply(path, **splats(), extra={"binding_0": torch.zeros(3)})
    with pytest.raises(ValueError, match=r"^comments"):
        save_ply(path, **splats(), comments=["x" * 70_000])
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_wrong_tensors_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^quats must have the shape"):
        save_ply(tmp_path / "a.ply", **(splats() | {"quats": torch.zeros(40, 3)}))
    with pytest.raises(ValueError, match=r"^colors must have 1, 4, 9 or 16"):
        save_ply(tmp_path / "a.ply", **splats(harmonics=5))
