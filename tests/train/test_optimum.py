"""The truth is what the losses of the preset `tiny` ask for: on an exact head every change costs."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.train.common import PaintedPeople
from uika.head import load_head
from uika.train import TRAINING, Draw, Item, ItemMaker
from uika.train.tasks import ReconstructionTask

Output = tuple[Tensor, ...]
CONFIG = replace(
    TRAINING["tiny"], fitted=0.0, augment=False, size=64, texels=96, targets=3, sources=1, scope="all", least_scale=None
)


@pytest.fixture(scope="module")
def exact() -> tuple[ReconstructionTask, Item, Output]:
    """A task, an exact head and the surface itself in its true colours."""
    task = ReconstructionTask(CONFIG, load_head().without_bust)
    item = ItemMaker(PaintedPeople(), CONFIG)[Draw(0, 0, 1, 3)]
    texel = task.network._binding.texel
    truth = item.texture.flatten(1)[:, texel].mT
    known = truth[:, 3]
    colors = torch.where(truth[:, 3:] > 0, truth[:, :3], truth[:, :3][known > 0].mean(0))
    opacities = torch.full((len(colors),), CONFIG.model.gaussians.init_opacity)
    still = torch.zeros_like(colors)
    return task, item, (item.points, item.quats, item.scales, opacities, colors, still, colors, known)


def inwards(output: Output, millimetres: float) -> Output:
    means, quats, *rest = output
    w, x, y, z = quats.unbind(-1)
    normals = torch.stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), -1)
    moved = -millimetres / 1000 * normals
    return means + moved, quats, *rest[:3], moved, *rest[4:]


def larger(output: Output, factor: float) -> Output:
    return *output[:2], output[2] * factor, *output[3:]


def opaque(output: Output, opacity: float) -> Output:
    return *output[:3], torch.full_like(output[3], opacity), *output[4:]


def brighter(output: Output, level: float) -> Output:
    return *output[:4], output[4] + level, *output[5:]


CHANGES: dict[str, tuple[Callable[[Output, float], Output], float, tuple[float, ...]]] = {
    "geometry in mm": (inwards, 0.0, (-3.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 3.0)),
    "size": (larger, 1.0, (0.6, 0.8, 1.2, 1.5)),
    "opacity": (opaque, 0.95, (0.4, 0.6, 0.8)),
    "colour": (brighter, 0.0, (-0.1, -0.05, -0.02, 0.02, 0.05, 0.1)),
}


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_of_an_exact_head_costs(name: str, exact: tuple[ReconstructionTask, Item, Output]) -> None:
    task, item, truth = exact
    change, none, values = CHANGES[name]
    totals = {value: total(task, change(truth, value), item) for value in (none, *values)}
    print(name, totals)
    assert min(totals, key=totals.__getitem__) == none, totals


def test_masks_alone_would_draw_an_exact_head_in(exact: tuple[ReconstructionTask, Item, Output]) -> None:
    """Why pictures are compared with what splats of the true surface cover: masks have their optimum elsewhere."""
    task, _, truth = exact
    item = ItemMaker(PaintedPeople(), replace(CONFIG, outline="mask"))[Draw(0, 0, 1, 3)]
    still, drawn_in = (task.terms(inwards(truth, value), item)["alpha"] for value in (0.0, 1.0))
    assert drawn_in < 0.9 * still


def total(task: ReconstructionTask, output: Output, item: Item) -> float:
    """The loss that is minimised."""
    terms = task.terms(output, item)
    return float(sum(value for name, value in terms.items() if not name.startswith("psnr")))
