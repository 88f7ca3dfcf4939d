"""The true colours of the atlas, and the loss on them."""

from dataclasses import replace

import pytest
import torch

from tests.train.common import CONFIG, MICRO, PaintedPerson, run
from uika.data.texture import true_texture
from uika.data.views import View
from uika.head import load_head, uv_texels
from uika.model import load_checkpoint
from uika.train import MODEL_FILE, LossWeights
from uika.train.tasks import ReconstructionTask

pytestmark = pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")


def test_texture_holds_the_paint_of_every_view() -> None:
    head, person = load_head().without_bust, PaintedPerson(3, views=6)
    texture = true_texture([View(person.sample(index), 64) for index in range(6)], 64)
    binding = uv_texels(head, 64)
    known = binding.from_map(texture[3:])[:, 0] > 0
    assert 0.2 < known.float().mean() < 1
    corners = head.template[head.faces[binding.triangle]]
    paint = ((0.5 + 0.4 * torch.sin(corners * 60 + 3)) * binding.barycentric[..., None]).sum(1)
    error = (binding.from_map(texture[:3]) - paint)[known].abs().mean()
    assert error < 0.05


def test_no_labels_no_texture() -> None:
    view = View(PaintedPerson(1).sample(0), 64)
    view.uv = None
    assert len(true_texture([view], 64)) == 0


def test_atlas_loss_is_zero_for_the_truth_and_counts_known_texels_alone() -> None:
    head = load_head().without_bust
    task = ReconstructionTask(replace(CONFIG, losses=LossWeights(atlas=1.0)), head)
    size = MICRO.map_size
    texel = uv_texels(head, size).texel
    texture = torch.rand(4, size, size, generator=torch.Generator().manual_seed(0))
    texture[3] = (texture[3] > 0.5).float()
    truth = texture.flatten(1)[:, texel].mT
    even = torch.ones(len(truth))
    assert float(task._atlas(truth[:, :3], texture, even)) == 0
    shifted = truth[:, :3] + 0.25 * truth[:, 3:] + 9 * (1 - truth[:, 3:])
    assert abs(float(task._atlas(shifted, texture, even)) - 0.25) < 1e-6


def test_a_coarser_atlas_in_training_leaves_the_model_file_at_its_own_size(tmp_path) -> None:
    config = replace(CONFIG, texels=32, atlas_views=1, losses=LossWeights(atlas=1.0), steps=1)
    log = run(tmp_path, config)
    assert log[0]["atlas"] > 0
    assert load_checkpoint(tmp_path / MODEL_FILE).config.map_size == MICRO.map_size
