"""Prepared pictures of synthetic people with codes of the surface."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from uika.data import DataError
from uika.data.encode import decode_uv
from uika.data.identity import Recording, record_identity
from uika.data.surface_items import CODE_STEP, ItemSettings, SurfaceItems, make_items, person_items
from uika.errors import UikaError
from uika.head import load_head
from uika.model.surface_codes import UvLookup, surface_table

FEW = ItemSettings(seed=3, size=64, views=2, moments=(0,))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("items")
    assert make_items(path, load_head(), range(2), FEW) == 2
    return path


def test_items_show_what_the_renderer_says(folder: Path) -> None:
    """Codes of a stored picture lead to the correspondence that was rendered with it."""
    head = load_head().without_bust
    items = SurfaceItems(folder, [1])
    assert len(items) == 2
    _, moments = record_identity(head, FEW.seed, 1, Recording(FEW.views, 1, 256))
    files = next(moments).views[1][1]
    uv, valid = decode_uv(files["uv_path"], "uv")
    item = items[1]
    rows, columns = (item.shown > 0).nonzero(as_tuple=True)
    assert len(rows) > 500
    at = ((torch.stack((rows, columns)) + 0.5) * 4).long().clamp(max=255).numpy()
    truth = torch.from_numpy(uv[at[0], at[1]])
    assert valid[at[0], at[1]].mean() > 0.99
    found, _ = UvLookup(surface_table(head, 128))(item.code[:, rows, columns].mT.float() * CODE_STEP)
    error = 384 * (found - truth).norm(dim=-1)
    assert float(error.median()) < 0.3
    assert float((error < 2).float().mean()) > 0.95


def test_mattes_are_those_of_the_matting_code_in_some_pictures(folder: Path) -> None:
    items = SurfaceItems(folder)
    apart = [float((item.mask.float() - item.matte.float()).abs().mean()) for item in (items[k] for k in range(4))]
    assert min(apart) == 0 and max(apart) > 0
    for item in (items[k] for k in range(4)):
        sure = item.shown > 0
        assert float((item.matte[sure] > 127).float().mean()) > 0.8


def test_a_run_goes_on_and_makes_the_same_files(folder: Path, tmp_path: Path) -> None:
    first = folder / "000001.safetensors"
    assert make_items(folder, load_head(), range(2), FEW) == 0
    again = [torch.stack(parts) for parts in zip(*person_items(load_head(), 1, FEW), strict=True)]
    items = SurfaceItems(folder, [1])
    for index in range(2):
        for stored, made in zip(items[index], again, strict=True):
            assert float((stored.float() - made[index].float()).abs().max()) <= 1  # of whole numbers
    assert first.exists() and not list(tmp_path.iterdir())


def test_other_settings_and_damage_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UikaError, match="made with other settings"):
        make_items(folder, load_head(), range(1), replace(FEW, seed=4))
    with pytest.raises(UikaError, match="holds no items"):
        SurfaceItems(tmp_path)
    for name in ("items.json", "000000.safetensors"):
        (tmp_path / name).write_bytes((folder / name).read_bytes()[: 400 if name[0] == "0" else None])
    with pytest.raises(DataError, match="000000"):
        SurfaceItems(tmp_path)[0]
    with pytest.raises(UikaError, match="pixels"):
        ItemSettings(size=8)
    assert np.isfinite(len(SurfaceItems(folder)))
