"""The paper's ablations in small: `python -m benchmarks.ablations --train PEOPLE --data HELD_OUT`.

Each variant is trained from nothing with the same budget, seed and order of data, then judged on the same photos and
targets of people it never saw. Finished trainings and verdicts under `--runs` are kept, so that a second call goes on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.harness import markdown, save
from uika.head import load_head
from uika.io.progress import counted
from uika.metrics import flip, psnr, ssim
from uika.model import PRESETS, load_checkpoint
from uika.train import MODEL_FILE, TRAINING, Group, Setup, Stored, TrainConfig, train
from uika.train.dataset import ItemMaker
from uika.train.sampler import Draw
from uika.train.tasks import ReconstructionTask

SIZE, TEXELS = 128, 128
VIEWS = (1, 4)
BASE = replace(PRESETS["tiny"], image_size=SIZE)
METRICS = {"PSNR": psnr, "SSIM": ssim, "FLIP": flip}
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "full": {},
    "w/o UV attention": {"uv_attention": False},
    "w/o aggregation": {"aggregation": False},
    "fixed fusion weight": {"fusion": "fixed"},
    "10 % of the identities": {},
}


class Some:
    """The first people of a set."""

    def __init__(self, people: Stored, count: int) -> None:
        self._people, self._count = people, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Any:
        return self._people[index]


def config_of(name: str, steps: int) -> TrainConfig:
    """The training of a variant."""
    return replace(
        TRAINING["tiny"],
        architecture=replace(BASE, **VARIANTS[name]),
        steps=steps,
        size=SIZE,
        texels=TEXELS,
        fitted=0.0,
        ema=0.98,
        save_every=100,
        keep=1,
    )


@torch.no_grad()
def judge(model: Path, config: TrainConfig, people: Stored, count: int) -> list[dict[str, Any]]:
    """Scores of a model for each person and number of photos; photos and targets depend on the person alone."""
    head = load_head().without_bust
    plain = replace(config, augment=False, targets=4, losses=replace(config.losses, atlas=0.0))
    task, maker = ReconstructionTask(plain, head), ItemMaker(people, plain)
    task.model.load_state_dict(load_checkpoint(model).state_dict())
    task.network.eval()
    rows = []
    for person in range(count):
        for views in VIEWS:
            item = maker[Draw(0, person, views, 1000 + person)]
            images, _ = task.render(task.network([item])[0], item)
            pairs = [
                (image.permute(1, 2, 0).clamp(0, 1), truth.permute(1, 2, 0))
                for image, truth in zip(images, item.pictures, strict=True)
            ]
            scores = {name: [score(*pair) for pair in pairs] for name, score in METRICS.items()}
            rows.append({"person": person, "views": views} | {k: float(sum(v) / len(v)) for k, v in scores.items()})
    return rows


def table(verdicts: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Means over people as Markdown."""
    lines = []
    for name, rows in verdicts.items():
        line: dict[str, object] = {"variant": name}
        for views in VIEWS:
            own = [row for row in rows if row["views"] == views]
            for metric, digits in (("PSNR", 2), ("SSIM", 3), ("FLIP", 3)):
                line[f"{metric}, N = {views}"] = round(sum(row[metric] for row in own) / len(own), digits)
        lines.append(line)
    return markdown(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True, help="held-out people")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--people", type=int, default=24, help="held-out people to judge with")
    parser.add_argument("--runs", type=Path, default=Path("out/ablations"))
    options = parser.parse_args()
    everyone, held_out = Stored([options.train]), Stored([options.data])
    verdicts: dict[str, list[dict[str, Any]]] = {}
    for name in counted(list(VARIANTS), True, len(VARIANTS), "variants"):
        config = config_of(name, options.steps)
        folder = options.runs / name.replace("/", "").replace(" ", "_")
        verdict = folder / "verdict.json"
        if not verdict.exists():
            share = len(everyone) // 10 if name.startswith("10 %") else len(everyone)
            alone = Group(0, 1, torch.device("cpu"))
            model = train(config, Some(everyone, share), Setup(folder, resume=(folder / "checkpoints").exists()), alone)
            verdict.write_text(json.dumps(judge(model, config, held_out, options.people)))
        verdicts[name] = json.loads(verdict.read_text())
    text = (
        f"{options.steps} steps on {len(everyone)} people, {SIZE} x {SIZE} pixels, exact correspondence; "
        f"{options.people} people never seen, four targets each.\n\n{table(verdicts)}"
    )
    save("ablations", "Ablations in small", text, {"verdicts": verdicts, "model_file": MODEL_FILE})


if __name__ == "__main__":
    main()
