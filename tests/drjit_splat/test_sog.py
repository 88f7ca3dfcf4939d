"""`.sog` bundles written by the format's description are read as another library reads them; damaged ones are named."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from drjit_splat import SplatFile, load_sog, load_splats

from .test_spz import made_up

pytest.importorskip("PIL", reason="skipped: pillow is not installed")
COUNT = 70  # more than one row of the palette
RECORDED = Path(__file__).with_name("recorded")
Files = dict[str, bytes]


def webp(pixels: np.ndarray) -> bytes:
    """Pixels [N,C] or [H,W,C] as a lossless picture."""
    from PIL import Image

    if pixels.ndim == 2:
        width = 16
        padded = np.zeros((-(-len(pixels) // width) * width, pixels.shape[1]), np.uint8)
        padded[: len(pixels)] = pixels
        pixels = padded.reshape(-1, width, pixels.shape[1])
    out = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


def nearest(codebook: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.abs(values[..., None] - codebook).argmin(-1).astype(np.uint8)


def bundle(splats: SplatFile) -> tuple[dict[str, Any], Files]:
    """Description and pictures, laid out as the format's page says; the palette holds every splat's harmonics."""
    n = len(splats.means)
    means, quats = splats.means.double().numpy(), splats.quats.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    mins, maxs = logs.min(0), logs.max(0)
    fixed = np.rint((logs - mins) / (maxs - mins) * 65535).astype(np.int64)
    largest = np.abs(quats).argmax(-1)
    turned = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1, 1)
    small = np.stack([np.delete(row, k) for row, k in zip(turned, largest, strict=True)])
    packed = np.rint((small / np.sqrt(2) + 0.5) * 255)
    scales, sh = splats.scales.log().double().numpy(), splats.harmonics.double().numpy()
    books = {
        name: np.linspace(values.min(), values.max(), 256)
        for name, values in (("scales", scales), ("sh0", sh[:, 0]), ("shN", sh[:, 1:]))
    }
    each = sh.shape[1] - 1
    palette = np.zeros((-(-n // 64) * 64, each, 3), np.uint8)
    palette[:n] = nearest(books["shN"], sh[:, 1:])
    label = np.arange(n)
    alpha = np.rint(splats.opacities.numpy() * 255)[:, None]
    files = {
        "means_l.webp": webp(fixed & 255),
        "means_u.webp": webp(fixed >> 8),
        "quats.webp": webp(np.concatenate((packed, 252 + largest[:, None]), -1)),
        "scales.webp": webp(nearest(books["scales"], scales)),
        "sh0.webp": webp(np.concatenate((nearest(books["sh0"], sh[:, 0]), alpha), -1)),
        "shN_centroids.webp": webp(palette.reshape(-1, 64 * each, 3)),
        "shN_labels.webp": webp(np.stack((label & 255, label >> 8, 0 * label), -1)),
    }
    meta = {
        "version": 2,
        "count": n,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
        "scales": {"codebook": books["scales"].tolist(), "files": ["scales.webp"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": ["sh0.webp"]},
        "shN": {
            "count": n,
            "bands": 2,
            "codebook": books["shN"].tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        },
    }
    return meta, files


def write(path: Path, meta: Any, files: Files) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", meta if isinstance(meta, (bytes, str)) else json.dumps(meta))
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def test_what_is_written_by_the_description_is_read(tmp_path: Path) -> None:
    splats = made_up(COUNT, 2)
    meta, files = bundle(splats)
    found = load_splats(write(tmp_path / "a.sog", meta, files))
    torch.testing.assert_close(found.means, splats.means, atol=2e-3, rtol=0)
    torch.testing.assert_close(found.opacities, splats.opacities, atol=0.51 / 255, rtol=0)
    assert float((found.quats * splats.quats).sum(-1).abs().min()) > 1 - 1e-4
    for got, wanted in ((found.scales.log(), splats.scales.log()), (found.harmonics, splats.harmonics)):
        step = float(wanted.max() - wanted.min()) / 255
        torch.testing.assert_close(got, wanted, atol=0.51 * step, rtol=0)
    del meta["shN"]
    assert load_sog(write(tmp_path / "b.sog", meta, files)).degree == 0


def test_another_library_reads_the_same() -> None:
    """`gsply_sog.npz` is what gsply's reader made of `made_up.sog` (tools/record_splats.py)."""
    found = load_sog(RECORDED / "made_up.sog")
    with np.load(RECORDED / "gsply_sog.npz") as expected:
        for name, value in (
            ("means", found.means),
            ("scales", found.scales.log()),
            ("opacities", found.opacities.logit(1e-6)),
            ("sh0", found.harmonics[:, 0]),
            ("shN", found.harmonics[:, 1:]),
            ("quats", found.quats),
        ):
            np.testing.assert_allclose(value.numpy(), expected[name], atol=2e-5, rtol=1e-5, err_msg=name)


def changed(*keys: str, value: Any) -> Callable[[dict[str, Any], Files], Any]:
    def edit(meta: dict[str, Any], files: Files) -> None:
        for key in keys[:-1]:
            meta = meta[key]
        meta[keys[-1]] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (changed("version", value=1), "version 1; 2 can be read"),
        (changed("count", value=10**9), "at most 20,000,000"),
        (changed("count", value=COUNT + 11), "80 pixels for 81 splats"),
        (changed("means", value={}), "KeyError: 'files'"),
        (changed("means", "mins", value=[0.0]), "cannot reshape"),
        (changed("scales", "codebook", value=[0.0] * 255), "cannot reshape"),
        (changed("quats", "files", value=["sh0.webp"]), "which of its components"),
        (changed("sh0", "files", value=["../../etc/passwd"]), "KeyError"),
        (changed("shN", "bands", value=4), "4 bands"),
        (changed("shN", "count", value=3), "has the harmonics 69, of 3"),
        (changed("shN", "count", value=10**6), "pixels for 1000000 entries"),
        (lambda meta, files: files.update({"sh0.webp": b"no picture"}), "cannot identify|UnidentifiedImageError"),
        (lambda meta, files: files.pop("scales.webp"), "scales.webp"),
    ],
)
def test_unusable_bundles_are_named(tmp_path: Path, edit: Any, message: str) -> None:
    meta, files = bundle(made_up(COUNT, 2))
    edit(meta, files)
    with pytest.raises(ValueError, match=message) as refused:
        load_sog(write(tmp_path / "bad.sog", meta, files))
    assert str(refused.value).startswith(str(tmp_path / "bad.sog"))


def test_what_is_no_archive_is_named(tmp_path: Path) -> None:
    for data in (b"", b"ply\n", b"PK\x03\x04" + bytes(40)):
        (tmp_path / "bad.sog").write_bytes(data)
        with pytest.raises(ValueError, match=r"bad\.sog is no \.sog file"):
            load_sog(tmp_path / "bad.sog")
