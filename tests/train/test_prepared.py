"""Items that are made once: equal to those made on the way, resumable, never of other people or values."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.train.common import CONFIG, PaintedPeople, PaintedPerson, losses, run
from uika.data import DataError
from uika.errors import UikaError
from uika.train import Draw, Item, ItemMaker, PreparedItems
from uika.train.prepared import read_item, write_item

AUGMENTED = replace(CONFIG, augment=True, own=1, variants=2)


class OtherPeople(PaintedPeople):
    def __getitem__(self, index: int) -> PaintedPerson:
        return PaintedPerson(index + 7)


def same(first: Item, second: Item) -> bool:
    fields = vars(first).items()
    tensors = [(value, getattr(second, name)) for name, value in fields if isinstance(value, torch.Tensor)]
    return first.keys == second.keys and all(torch.equal(a.nan_to_num(-9), b.nan_to_num(-9)) for a, b in tensors)


def test_prepared_items_equal_those_made_on_the_way(tmp_path: Path) -> None:
    items, maker = PreparedItems(tmp_path, PaintedPeople(), AUGMENTED), ItemMaker(PaintedPeople(), AUGMENTED)
    draws = [Draw(3, 1, 2, 12), Draw(8, 1, 2, 13), Draw(9, 1, 2, 14)]
    made = [items[draw] for draw in draws]
    assert len(list(tmp_path.glob("000001/*.safetensors"))) == 2
    assert all(same(item, maker[items.kept(draw)]) for item, draw in zip(made, draws, strict=True))
    assert same(made[0], made[2]) and not same(made[0], made[1])
    assert same(items[draws[1]], made[1])  # read this time


def test_shards_and_an_interrupted_preparation_make_the_whole(tmp_path: Path) -> None:
    config = replace(AUGMENTED, sources=1)
    whole = PreparedItems(tmp_path / "whole", PaintedPeople(), config)
    assert whole.prepare() == 6 and whole.prepare() == 0
    parts = PreparedItems(tmp_path / "parts", PaintedPeople(), config)
    assert parts.prepare(1, 2) == 2
    parts.path(1, 1, 0).unlink()  # as if stopped there
    assert parts.prepare(0, 2) == 4 and parts.prepare(1, 2) == 1
    for person in range(3):
        for variant in range(2):
            files = [items.path(person, 1, variant).read_bytes() for items in (whole, parts)]
            assert files[0] == files[1]


def test_a_training_reads_prepared_items(tmp_path: Path) -> None:
    items = tmp_path / "items"
    first = losses(run(tmp_path / "a", AUGMENTED, items=items))
    before = {path: path.stat().st_mtime_ns for path in items.rglob("*.safetensors")}
    assert losses(run(tmp_path / "b", AUGMENTED, items=items)) == pytest.approx(first, rel=1e-5)
    assert {path: path.stat().st_mtime_ns for path in items.rglob("*.safetensors")} == before


def test_items_of_other_people_or_values_are_refused(tmp_path: Path) -> None:
    PreparedItems(tmp_path, PaintedPeople(), AUGMENTED)
    with pytest.raises(UikaError, match="made with size 64, not 128"):
        PreparedItems(tmp_path, PaintedPeople(), replace(AUGMENTED, size=128))
    with pytest.raises(UikaError, match="first_image"):
        PreparedItems(tmp_path, OtherPeople(), AUGMENTED)
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(UikaError, match=r"settings\.json: cannot be read"):
        PreparedItems(tmp_path, PaintedPeople(), AUGMENTED)


def test_a_damaged_item_is_named(tmp_path: Path) -> None:
    path = tmp_path / "item.safetensors"
    write_item(path, ItemMaker(PaintedPeople(), AUGMENTED)[Draw(0, 0, 1, 1)])
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=r"item\.safetensors: is no item or damaged"):
        read_item(path)
    with pytest.raises(FileNotFoundError):
        read_item(tmp_path / "none.safetensors")
