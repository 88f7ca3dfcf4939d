"""`.splat` files: 32 bytes as other programs lay them out, and unusable ones named."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
import torch

from drjit_splat import load_splat, load_splats, save_splat

from .test_spz import made_up


def test_each_byte_has_its_place(tmp_path: Path) -> None:
    row = struct.pack("<6f4B4B", 1.5, -2, 0.25, 0.1, 0.2, 0.3, 255, 0, 51, 204, 255, 128, 128, 0)
    (tmp_path / "a.splat").write_bytes(row * 2)
    found = load_splats(tmp_path / "a.splat")
    torch.testing.assert_close(found.means[1], torch.tensor([1.5, -2, 0.25]))
    torch.testing.assert_close(found.scales[1], torch.tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(found.colors[1], torch.tensor([1.0, 0.0, 0.2]))
    torch.testing.assert_close(found.opacities[1], torch.tensor(0.8))
    torch.testing.assert_close(found.quats[1], torch.tensor([0.704, 0.0, 0.0, -0.710]), atol=1e-3, rtol=0)


def test_what_is_written_is_read_back_brightest_first(tmp_path: Path) -> None:
    splats = made_up(degree=0)
    colors = splats.colors.clamp(0, 1)
    save_splat(tmp_path / "a.splat", splats.means, splats.quats, splats.scales, splats.opacities, colors)
    found = load_splat(tmp_path / "a.splat")
    order = (splats.scales.prod(-1) * splats.opacities).argsort(descending=True)
    assert torch.equal(found.means, splats.means[order]) and torch.equal(found.scales, splats.scales[order])
    torch.testing.assert_close(found.opacities, splats.opacities[order], atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(found.colors, colors[order], atol=0.51 / 255, rtol=0)
    assert float((found.quats * splats.quats[order]).sum(-1).abs().min()) > 0.9995
    assert [path.name for path in tmp_path.iterdir()] == ["a.splat"]


def test_unusable_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.splat"
    path.write_bytes(bytes(33))
    with pytest.raises(ValueError, match=r"bad\.splat: is cut short"):
        load_splat(path)
    path.write_bytes(struct.pack("<2f", 1.0, float("nan")) + bytes(24))
    with pytest.raises(ValueError, match=r"bad\.splat: means\[0, 1\] is nan"):
        load_splat(path)
    with pytest.raises(ValueError, match=r"a\.ksplat: splat files end in \.ply, \.sog, \.splat, \.spz"):
        load_splats(tmp_path / "a.ksplat")
    bad = torch.full((1, 3), torch.inf)
    with pytest.raises(ValueError, match="scales"):
        save_splat(path, torch.zeros(1, 3), torch.ones(1, 4), bad, torch.ones(1), torch.ones(1, 3))
