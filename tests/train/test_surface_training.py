"""The small correspondence estimator learns, goes on, and is judged by figures that mean what they say."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from uika.data.surface_items import CODE_STEP, ItemSettings, SurfaceItem, SurfaceItems, make_items
from uika.errors import UikaError
from uika.head import load_head
from uika.model.config import SurfaceEstimatorConfig
from uika.model.estimator_file import read_estimator
from uika.model.surface_codes import UvLookup, surface_table
from uika.model.surface_estimator import SurfaceEstimator, SurfaceMaps
from uika.train.surface_augment import make_batch, mirrored
from uika.train.surface_losses import surface_figures, surface_losses
from uika.train.surface_training import LOG, MODEL_FILE, SurfaceTraining, train_surface

ARCHITECTURE = SurfaceEstimatorConfig(size=64, widths=(8, 16, 16), blocks=(1, 1, 1), table=64)
SHORT = SurfaceTraining(
    ARCHITECTURE, 12, people=2, held_out=1, batch=4, coarse=3, warmup=2, save_every=6, judged=4, learning_rate=4e-3
)


@pytest.fixture(scope="module")
def items(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("items")
    make_items(path, load_head(), range(2), ItemSettings(seed=5, size=64, views=2, moments=(0,)))
    return path


def test_training_lowers_its_loss_and_resumes_to_the_same_weights(items: Path, tmp_path: Path) -> None:
    whole = train_surface(tmp_path / "whole", items, load_head(), SHORT, say=lambda _: None)
    lines = [json.loads(line) for line in (tmp_path / "whole" / LOG).read_text().splitlines()]
    assert [line["step"] for line in lines] == [6, 12]
    assert lines[1]["loss_place"] < 0.9 * lines[0]["loss_place"]
    assert lines[1]["skin"] > 0 and 0 <= lines[1]["hard_missed"] <= 1
    # A longer plan that is cut off half way, and goes on.
    train_surface(tmp_path / "cut", items, load_head(), replace(SHORT, steps=6, cooldown=0.01), say=lambda _: None)
    with pytest.raises(UikaError, match="--resume"):
        train_surface(tmp_path / "cut", items, load_head(), SHORT)
    with pytest.raises(UikaError, match="was trained with batch"):
        train_surface(tmp_path / "cut", items, load_head(), replace(SHORT, batch=3), resume=True)
    plan = replace(SHORT, steps=12, cooldown=0.01)
    train_surface(tmp_path / "cut", items, load_head(), plan, resume=True, say=lambda _: None)
    train_surface(tmp_path / "uncut", items, load_head(), plan, say=lambda _: None)
    one, other = (read_estimator(tmp_path / name / MODEL_FILE).state_dict() for name in ("cut", "uncut"))
    for name, value in one.items():
        assert torch.allclose(value.float(), other[name].float(), atol=2e-3), name
    assert isinstance(read_estimator(whole), SurfaceEstimator)


def exact(batch_item: SurfaceItem, augment: bool) -> tuple[SurfaceMaps, object]:
    batch = make_batch([batch_item], 64, 32, 7, augment)
    head = torch.where((batch.shown > 0) & (batch.person > 0.3), 9.0, -9.0)
    hair = torch.where(batch.shown == 2, 9.0, -9.0)
    return SurfaceMaps(batch.code.clone(), torch.full_like(head, -4.0), head, hair), batch


@pytest.mark.parametrize("augment", [False, True])
def test_the_truth_is_the_losses_optimum_and_without_error(items: Path, augment: bool) -> None:
    maps, batch = exact(SurfaceItems(items)[0], augment)
    lookup = UvLookup(surface_table(load_head().without_bust, 128))
    best = surface_losses(maps, batch)
    figures = surface_figures([(maps, batch)], lookup)
    assert figures["skin"] == 0 and figures["kept"] == 1 and figures["missed"] == 0
    for step in (0.02, -0.02):
        worse = surface_losses(maps._replace(code=maps.code + step), batch)
        assert worse["place"] > best["place"] + 0.1
        far = surface_figures([(maps._replace(code=maps.code + step), batch)], lookup)
        assert 1 < far["skin"] < 6  # 3.5 mm, at about a texel a millimetre
    assert surface_losses(maps._replace(head=-maps.head), batch)["head"] > best["head"] + 0.1
    assert surface_losses(maps._replace(hair=-maps.hair), batch)["hair"] > best["hair"] + 0.1


def test_augmented_labels_stay_on_their_pixels(items: Path) -> None:
    """A picture that is its own label in colours shows whether crops and mirroring move both alike."""
    item = SurfaceItems(items)[0]
    painted = (item.code[:3].float() * CODE_STEP / 3 + 0.5) * (item.shown > 0)
    item = item._replace(image=(255 * painted).round().clamp(0, 255).byte())
    batch = make_batch([item], 64, 64, 1, augment=False)
    batch = mirrored(batch, torch.tensor([True]))
    inner = -torch.nn.functional.max_pool2d(-(batch.shown > 0).float(), 5, 1, 2)[0] > 0
    assert int(inner.sum()) > 200
    colour = (batch.image[0, :3][:, inner] - 0.5) * 3
    side = torch.tensor([-1.0, 1.0, 1.0])[:, None]  # mirrored pictures show the other side of the head
    assert float((colour - side * batch.code[0, :3][:, inner]).abs().median()) < 0.03


def test_batches_repeat(items: Path) -> None:
    rows = [SurfaceItems(items)[k] for k in range(2)]
    one, other, third = make_batch(rows, 64, 32, 1), make_batch(rows, 64, 32, 1), make_batch(rows, 64, 32, 2)
    assert torch.equal(one.image, other.image) and not torch.equal(one.image, third.image)
    assert torch.isfinite(one.image).all() and one.image.min() >= 0 and one.image.max() <= 1


def test_the_rate_ends_at_nothing() -> None:
    rates = [SHORT.rate(step) for step in range(SHORT.steps)]
    assert rates[0] < rates[1] == max(rates) and rates[-1] < 0.2 * max(rates)
    with pytest.raises(UikaError, match="held out"):
        SurfaceTraining(people=30, held_out=40)
