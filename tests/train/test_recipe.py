"""The paper's recipe, value by value (docs/paper.md), and what a training on the template does with it."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.train.common import CONFIG, SIZE, PaintedPeople, losses, run
from uika.head import HeadParameters, load_head, skin_points, uv_texels
from uika.head.binding import surface_points
from uika.model import ESTIMATORS, PRESETS
from uika.train import TRAINING, Draw, ItemMaker
from uika.train.optimiser import batch_size, learning_rate, make_optimizer
from uika.train.sampler import Sampler, SamplerConfig
from uika.train.tasks import ReconstructionTask

pytestmark = pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")
PAPER = TRAINING["paper"]
SMALL = replace(
    PRESETS["paper"],
    name="small paper",
    image_size=SIZE,
    map_size=32,
    token_grid=8,
    backbone=replace(CONFIG.finished.backbone, taps=(0, 1)),
    dim=32,
    heads=2,
    layers=4,
    outputs=(1, 2, 3, 4),
    dpt_projections=(8, 8, 8, 8),
    dpt_features=8,
    mlp_width=16,
)
ON_TEMPLATE = replace(CONFIG, architecture=SMALL, facing=-1.0, backgrounds=PAPER.backgrounds, optimizer="adam")


def test_sizes_as_printed() -> None:
    """Supplement, table S1."""
    model = PRESETS["paper"]
    assert (model.image_size, PAPER.size) == (512, 512)
    assert (model.backbone.depth, model.backbone.dim, model.backbone.patch_size) == (24, 1024, 16)
    assert model.backbone.taps == (4, 11, 17, 23) and model.backbone.frozen
    assert (model.dim, model.heads, model.layers, model.outputs) == (1024, 16, 12, (3, 6, 9, 12))
    assert model.token_grid**2 == 9216
    assert (model.map_size, model.dpt_features, model.mlp_width) == (384, 256, 512)
    gaussians = model.gaussians
    assert 2 * gaussians.offset_range == 0.2  # the span; the released arithmetic is (sigmoid - 0.5) * 0.2
    assert (gaussians.scale_clip, gaussians.init_scale, gaussians.init_opacity) == (0.01, -5.0, 0.1)
    assert ESTIMATORS["paper"].layers == 4 and ESTIMATORS["paper"].backbone.frozen


def test_training_as_printed() -> None:
    """Section 4.1."""
    assert (PAPER.sources, PAPER.targets, PAPER.steps) == (16, 8, 150_000)
    assert (PAPER.optimizer, PAPER.weight_decay, PAPER.ema) == ("adam", 0.0, 0.0)
    losses = PAPER.losses
    assert (losses.l1, losses.lpips, losses.ssim, losses.offset) == (1.0, 1.0, 0.1, 0.1)
    assert (losses.alpha, losses.entropy, losses.atlas, losses.relief) == (0.0, 0.0, 0.0, 0.0)
    assert not PAPER.augment and PAPER.fitted == 0.0
    assert sorted(PAPER.backgrounds) == [0.0, 0.5, 1.0]  # black, grey and white, once each
    assert PAPER.facing == -1.0  # any view may be a source
    assert PRESETS["paper"].canonical == "template"


def test_values_that_are_not_printed_are_the_released_ones() -> None:
    assert (PAPER.learning_rate, PAPER.warmup, PAPER.betas, PAPER.clip) == (4e-4, 3000, (0.9, 0.95), 1.0)
    assert [batch_size(n, PAPER.images, PAPER.items) for n in (1, 2, 3, 4, 5, 6, 8, 9, 16)] == [
        8,
        8,
        5,
        4,
        3,
        2,
        2,
        1,
        1,
    ]
    assert learning_rate(2999, 4e-4, 3000, 150_000) == pytest.approx(4e-4)
    assert learning_rate(149_999, 4e-4, 3000, 150_000) == 0


def test_adam_decays_nothing() -> None:
    network = torch.nn.Linear(2, 2)
    optimizer = make_optimizer(network, PAPER)
    assert type(optimizer) is torch.optim.Adam
    assert all(group["weight_decay"] == 0 for group in optimizer.param_groups)


def test_sources_are_any_number_up_to_sixteen() -> None:
    sampler = Sampler(SamplerConfig(people=10, most_sources=PAPER.sources))
    counts = np.bincount([sampler.sources(step) for step in range(3200)], minlength=17)
    assert counts[0] == 0 and counts[1:].min() > 120 and counts[1:].max() < 290


def test_backgrounds_are_drawn_evenly() -> None:
    maker = ItemMaker(PaintedPeople(), replace(ON_TEMPLATE, part="estimator"))
    seen = [round(float(maker[Draw(0, 0, 1, seed)].images[0, 0, 0, 0]), 2) for seed in range(36)]
    counts = {level: seen.count(level) for level in (0.0, 0.5, 1.0)}
    assert sum(counts.values()) == 36 and min(counts.values()) > 5


def test_gaussians_start_on_the_template() -> None:
    head = load_head().without_bust
    item = ItemMaker(PaintedPeople(), ON_TEMPLATE)[Draw(0, 1, 2, 5)]
    binding = uv_texels(head, 32, "released")
    torch.testing.assert_close(item.points, surface_points(head.template, head.faces, binding), rtol=0, atol=0)
    assert item.driving is not None and float(item.driving.identity.abs().max()) == 0
    assert item.driving.batch_shape == (ON_TEMPLATE.targets,)


def test_gaussians_are_moved_by_skinning_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    head = load_head().without_bust
    item = ItemMaker(PaintedPeople(), ON_TEMPLATE)[Draw(0, 1, 1, 5)]
    moved = HeadParameters.zeros(head, 1).replace(
        jaw=torch.tensor([[0.2, 0.0, 0.0]]), neck=torch.tensor([[0.0, 0.3, 0]])
    )
    item = dataclasses.replace(item, driving=moved)
    task = ReconstructionTask(ON_TEMPLATE, head)
    (output,) = task.network([item])
    drawn = []
    import drjit_splat

    real = drjit_splat.rasterization
    monkeypatch.setattr(drjit_splat, "rasterization", lambda *a, **k: drawn.append(a) or real(*a, **k))
    task.render(output, item)
    means, quats, scales = drawn[0][:3]
    expected = skin_points(output[0], head, moved[0], uv_texels(head, 32, "released"))
    torch.testing.assert_close(means, expected)
    assert torch.equal(quats, output[1]) and torch.equal(scales, output[2])


def test_a_training_on_the_template_learns(tmp_path: Path) -> None:
    config = replace(ON_TEMPLATE, steps=30, warmup=2, learning_rate=5e-3, ema=0.0, save_every=30, backgrounds=(1.0,))
    log = run(tmp_path, config, overfit=1)
    assert losses(log)[-1] < 0.9 * losses(log)[0]
