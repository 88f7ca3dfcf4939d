"""Photos of a made-up person on the way that a user's photos take."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from uika.data.datasets import Person, Synthetic
from uika.data.views import View
from uika.head import load_head
from uika.train import TRAINING, Draw, ItemMaker
from uika.train.augment import Grade, degrade
from uika.train.photographed import photograph
from uika.train.tasks import ReconstructionTask

CONFIG = replace(TRAINING["tiny"], fitted=1.0, sources=2, texels=128, atlas_views=1)
PLAIN = Grade()


@pytest.fixture(scope="module")
def people(tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return Synthetic(tmp_path_factory.mktemp("people"), 1, views=5, frames=1, size=256, seed=7)


@pytest.fixture(scope="module")
def person(people: Synthetic) -> Person:
    return people[0]


@pytest.mark.slow
def test_the_clean_view_lies_on_the_prepared_photo(person: Person) -> None:
    view = View(person.sample(0), 128)
    for random in (None, tight()):
        taken = photograph(view, PLAIN, PLAIN, random)
        assert taken is not None
        photo, clean = taken.prepared.photo, taken.view
        sure = (photo.matte > 0.98) & (clean.mask > 0.98)
        assert sure.float().mean() > 0.1
        assert (photo.image - clean.image)[:, sure].abs().mean() < (0.02 if random is None else 0.06)


@pytest.mark.slow
def test_the_fitted_camera_sees_the_surface_where_the_photo_shows_it(people: Synthetic) -> None:
    item = ItemMaker(people, CONFIG)[Draw(0, 0, 2, 3)]
    task = ReconstructionTask(CONFIG, load_head().without_bust)
    with torch.no_grad():
        pictures, coverage = task.render(task.network([item])[0], item)
    own, person = coverage[-1] > 0.5, item.person[-1] > 0.5
    assert float((own & person).sum() / (own | person).sum()) > 0.9
    inside = (own & person).expand(3, -1, -1)
    assert float((pictures[-1] - item.pictures[-1])[inside].abs().mean()) < 0.06
    estimated, true = item.masks[0] > 0.5, item.person[-1] > 0.5
    assert not torch.equal(estimated, true)


@pytest.mark.slow
def test_photographed_items_are_functions_of_their_draws(people: Synthetic) -> None:
    first, other = ItemMaker(people, CONFIG), ItemMaker(people, CONFIG)
    other[Draw(0, 0, 1, 8)]  # photos that the second item shares
    items = first[Draw(0, 0, 1, 9)], other[Draw(5, 0, 1, 9)]
    assert torch.equal(items[0].images, items[1].images) and torch.equal(items[0].posed, items[1].posed)


@pytest.mark.slow
def test_somebody_without_a_face_is_named(people: Synthetic) -> None:
    class Backs:
        def __len__(self) -> int:
            return 1

        def sample(self, index: int):
            sample = people[0].sample(index)
            return replace(sample, image=torch.full_like(sample.image, 0.5))

    from uika.data import DataError

    class All:
        def __len__(self) -> int:
            return 3

        def __getitem__(self, index: int) -> Backs:
            return Backs()

    with pytest.raises(DataError, match="no face is found in any picture"):
        ItemMaker(All(), CONFIG)[Draw(0, 0, 1, 1)]


def test_photos_of_any_shape_are_degraded() -> None:
    for seed in range(12):
        assert degrade(torch.rand(3, 40, 64), np.random.default_rng(seed)).shape == (3, 40, 64)


def tight() -> np.random.Generator:
    """A generator whose first draw asks for a tight crop."""
    seed = next(seed for seed in range(100) if np.random.default_rng(seed).random() < 0.1)
    return np.random.default_rng(seed)
