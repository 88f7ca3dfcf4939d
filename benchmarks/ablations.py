"""The paper's ablations in small: `python -m benchmarks.ablations --train PEOPLE --data HELD_OUT`.

Each variant is trained from nothing with the same budget and the same order of data, once for each of several seeds,
then judged on the same photos and targets of people it never saw: over whole pictures, inside the person's mask, and on
the texels that no photo shows. Finished trainings and verdicts under `--runs` are kept, so that a second call goes on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import markdown, save
from uika.canonical.surface import canonical_binding
from uika.head import load_head
from uika.io.progress import counted
from uika.model import PRESETS, load_checkpoint
from uika.train import MODEL_FILE, TRAINING, Group, Item, Setup, Stored, TrainConfig, train
from uika.train.dataset import ItemMaker
from uika.train.sampler import Draw
from uika.train.tasks import ReconstructionTask

SIZE, TEXELS = 128, 128
VIEWS = (1, 4)
BASE = replace(PRESETS["tiny"], image_size=SIZE)
METRICS = ("psnr", "psnr_masked", "psnr_unseen")
# What of the architecture and of the training a variant changes.
VARIANTS: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    "full": ({}, {}),
    "w/o UV attention": ({"uv_attention": False}, {}),
    "w/o aggregation": ({"aggregation": False}, {}),
    "fixed fusion weight": ({"fusion": "fixed"}, {}),
    "10 % of the identities": ({}, {}),
    "trained on exact correspondence": ({}, {"fitted": 0.0}),
}


class Some:
    """The first people of a set."""

    def __init__(self, people: Stored, count: int) -> None:
        self._people, self._count = people, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Any:
        return self._people[index]


def config_of(name: str, steps: int, seed: int) -> TrainConfig:
    """The training of a variant."""
    architecture, training = VARIANTS[name]
    config = replace(TRAINING["tiny"], architecture=replace(BASE, **architecture), size=SIZE, texels=TEXELS)
    return replace(config, steps=steps, seed=seed, ema=0.98, save_every=100, keep=1, **training)


@torch.no_grad()
def judge(model: Path, config: TrainConfig, people: Stored, count: int) -> list[dict[str, Any]]:
    """Scores of a model for each person and number of photos; photos and targets depend on the person alone."""
    head = load_head().without_bust
    # One seed for all, so that all are judged on the same photos, fitted as in use.
    plain = replace(config, augment=False, targets=4, own=0, fitted=1.0, seed=0)
    task, maker = ReconstructionTask(plain, head), ItemMaker(people, plain)
    task.model.load_state_dict(load_checkpoint(model).state_dict())
    task.network.eval()
    rows = []
    for person in range(count):
        for views in VIEWS:
            item = maker[Draw(0, person, views, 1000 + person)]
            output = task.network([item])[0]
            terms = task.terms(output, item)
            scores = {name: float(terms[name]) for name in METRICS[:2]}
            rows.append({"person": person, "views": views, METRICS[2]: unseen(task, output, item), **scores})
    return rows


def unseen(task: ReconstructionTask, output: Sequence[Tensor], item: Item) -> float:
    """PSNR of the colours of texels that no photo shows, where their true colour is known."""
    texel = canonical_binding(load_head().without_bust, "personal", item.texture.shape[-1]).texel
    truth = item.texture.flatten(1)[:, texel].mT
    weight = truth[:, 3] * (1 - output[7])
    square = (output[4] - truth[:, :3]).square().mean(1)
    return float(-10 * torch.log10((square * weight).sum() / weight.sum().clamp_min(1e-6)))


def table(verdicts: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> str:
    """Means over people, then over seeds with the spread of the seeds, as Markdown."""
    lines = []
    for name, seeds in verdicts.items():
        line: dict[str, object] = {"variant": name}
        for views in VIEWS:
            for metric in METRICS:
                each = [mean(row[metric] for row in rows if row["views"] == views) for rows in seeds]
                spread = f" ± {stdev(each):.2f}" if len(each) > 1 else ""
                line[f"{metric.replace('psnr', 'PSNR').replace('_', ' ')}, N = {views}"] = f"{mean(each):.2f}{spread}"
        lines.append(line)
    return markdown(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True, help="held-out people")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--people", type=int, default=24, help="held-out people to judge with")
    parser.add_argument("--runs", type=Path, default=Path("out/ablations"))
    options = parser.parse_args()
    everyone, held_out = Stored([options.train]), Stored([options.data])
    verdicts: dict[str, list[list[dict[str, Any]]]] = {name: [] for name in VARIANTS}
    tasks = [(name, seed) for seed in range(options.seeds) for name in VARIANTS]
    for name, seed in counted(tasks, True, len(tasks), "trainings"):
        config = config_of(name, options.steps, seed)
        folder = options.runs / f"{name.replace('/', '').replace(' ', '_')}-{seed}"
        verdict = folder / "verdict.json"
        if not verdict.exists():
            share = max(1, len(everyone) // 10) if name.startswith("10 %") else len(everyone)
            alone = Group(0, 1, torch.device("cpu"))
            # The items of a seed are shared by its variants, but where correspondence is what differs.
            items = options.runs / f"items-{seed}-{config.fitted:g}"
            setup = Setup(folder, workers=0, resume=(folder / "checkpoints").exists(), items=items)
            model = train(config, Some(everyone, share), setup, alone)
            verdict.write_text(json.dumps(judge(model, config, held_out, options.people)))
        verdicts[name].append(json.loads(verdict.read_text()))
    text = (
        f"{options.steps} steps on {len(everyone)} people, {SIZE} x {SIZE} pixels, {options.seeds} seeds; "
        f"{options.people} people never seen, photos fitted as in use, four targets each.\n\n{table(verdicts)}"
    )
    save("ablations", "Ablations in small", text, {"verdicts": verdicts, "model_file": MODEL_FILE})


if __name__ == "__main__":
    main()
