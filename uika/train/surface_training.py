"""Training of the small correspondence estimator, on one thread, with checkpoints to go on from."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from uika._version import __version__
from uika.data.surface_items import SurfaceItems
from uika.errors import UikaError
from uika.head import HeadModel
from uika.io.files import check_folder, write_tensors
from uika.model.config import SurfaceEstimatorConfig
from uika.model.estimator_file import save_estimator
from uika.model.surface_codes import UvLookup, surface_table
from uika.model.surface_estimator import SurfaceEstimator
from uika.train.surface_augment import SurfaceBatch, make_batch, mirrored
from uika.train.surface_losses import surface_figures, surface_losses

MODEL_FILE, CHECKPOINT, LOG = "model.safetensors", "checkpoint.safetensors", "log.jsonl"
_FREE = ("steps", "people", "save_every", "cooldown")  # may change when a run goes on


@dataclass(frozen=True)
class SurfaceTraining:
    """How to train; people are numbers of synthetic people, of which the first `held_out` are never trained on."""

    architecture: SurfaceEstimatorConfig = field(default_factory=SurfaceEstimatorConfig)
    steps: int = 4000
    people: int = 440
    held_out: int = 30
    batch: int = 16
    coarse: int = 1500  # first steps, with pictures of three quarters of the side, which cost half as much
    learning_rate: float = 2e-3
    warmup: int = 100
    cooldown: float = 0.3  # last share of the steps, over which the rate falls to nothing
    weight_decay: float = 0.01
    keep: float = 0.995  # share of the running mean of the weights that stays in a step
    clip: float = 1.0
    seed: int = 0
    save_every: int = 200
    judged: int = 120  # held-out pictures

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if min(self.steps, self.batch, self.save_every, self.held_out, self.judged) < 1:
            raise UikaError("steps, batch, save_every, held_out and judged must be at least 1")
        if self.people <= self.held_out:
            raise UikaError(f"people must be more than the {self.held_out} that are held out, not {self.people}")

    def rate(self, step: int) -> float:
        """Learning rate of a step: a short rise, a plateau, a half cosine to nothing."""
        fall = max(1, round(self.cooldown * self.steps))
        left = min(1.0, (self.steps - step) / fall)
        return self.learning_rate * min(1.0, (step + 1) / self.warmup) * 0.5 * (1 - math.cos(math.pi * left))


def train_surface(
    folder: Path,
    items: Path,
    head: HeadModel,
    config: SurfaceTraining,
    resume: bool = False,
    say: Callable[[str], None] = print,
) -> Path:
    """Train until `config.steps`; `folder` holds a checkpoint, `log.jsonl` and `model.safetensors` all the while.

    Args:
        folder: of the run.
        items: folder of `uika.data.surface_items`.
        head: the head model.
        config: how.
        resume: go on from the checkpoint.
        say: gets a line at each checkpoint.

    Raises:
        UikaError: the folder holds another training, or items are missing.
    """
    head = head.without_bust
    check_folder(folder)
    checkpoint = folder / CHECKPOINT
    if checkpoint.exists() and not resume:
        raise UikaError(f"{folder}: already holds a training; add --resume to go on, or choose another folder")
    seen = SurfaceItems(items, range(config.held_out, config.people))
    judged = SurfaceItems(items, range(config.held_out))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = SurfaceEstimator(config.architecture, surface_table(head, config.architecture.table))
    network = model.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    start = _load(checkpoint, config, network, optimizer, mean) if checkpoint.exists() else 0
    lookup = UvLookup(surface_table(head, config.architecture.table))
    began, sums = time.process_time(), dict[str, float]()
    say(f"{len(seen.files)} people with {len(seen)} pictures, {len(judged.files)} held out; from step {start}")
    for step in range(start, config.steps):
        batch = _draw(seen, config, step)
        losses = surface_losses(network.train()(batch.image.contiguous(memory_format=torch.channels_last)), batch)
        loss = torch.stack(list(losses.values())).sum()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(network.parameters(), config.clip)
        if bool(torch.isfinite(norm)):
            optimizer.param_groups[0]["lr"] = config.rate(step)
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        _follow(mean, network, min(config.keep, (1 + step) / (10 + step)))
        for name, value in losses.items():
            sums[name] = sums.get(name, 0.0) + float(value.detach())
        if (step + 1) % config.save_every and step + 1 < config.steps:
            continue
        _save(checkpoint, config, network, optimizer, mean, step + 1)
        figures = _export(folder / MODEL_FILE, model, mean, judged, lookup, head, config, step + 1)
        count = (step % config.save_every) + 1
        line = {
            "step": step + 1,
            "pictures": (step + 1) * config.batch,
            "people": len(seen.files),
            "cpu_seconds": round(time.process_time() - began, 1),
            **{f"loss_{name}": value / count for name, value in sums.items()},
            **figures,
        }
        with (folder / LOG).open("a") as file:
            file.write(json.dumps(line) + "\n")
        say(" ".join(f"{name} {value:.4g}" for name, value in line.items()))
        sums = {}
    return folder / MODEL_FILE


def _draw(items: SurfaceItems, config: SurfaceTraining, step: int) -> SurfaceBatch:
    """The batch of a step, which depends on the seed and the step's number alone."""
    rows = []
    for place in range(step * config.batch, (step + 1) * config.batch):
        epoch, index = divmod(place, len(items))
        rows.append(items[int(np.random.default_rng([config.seed, epoch]).permutation(len(items))[index])])
    size = config.architecture.size if step >= config.coarse else 3 * config.architecture.size // 4
    batch = make_batch(rows, size, size // 2, config.seed + 1000 * step)
    flips = torch.from_numpy(np.random.default_rng([config.seed, step, 1]).random(config.batch) < 0.5)
    return mirrored(batch, flips)


def judge_surface(
    model: SurfaceEstimator, items: SurfaceItems, lookup: UvLookup, most: int, augment: bool
) -> dict[str, float]:
    """Figures of `surface_figures` on up to `most` pictures, evenly chosen; with `augment`, as hard as in training."""
    size = model.config.size
    count = min(most, len(items))
    rows = [items[index * len(items) // count] for index in range(count)]
    model.eval()
    pairs = []
    with torch.no_grad():
        for first in range(0, count, 20):
            batch = make_batch(rows[first : first + 20], size, size // 2, first, augment)
            pairs.append((model.network(batch.image), batch))
    return surface_figures(pairs, lookup)


def _export(
    path: Path,
    model: SurfaceEstimator,
    mean: dict[str, Tensor],
    judged: SurfaceItems,
    lookup: UvLookup,
    head: HeadModel,
    config: SurfaceTraining,
    step: int,
) -> dict[str, float]:
    """Write the running mean of the weights as a file for use; returns its figures on the held-out people."""
    table = surface_table(head, config.architecture.table)
    copy = SurfaceEstimator(config.architecture, table)
    copy.network.load_state_dict(mean)
    plain = judge_surface(copy, judged, lookup, config.judged, augment=False)
    hard = judge_surface(copy, judged, lookup, config.judged, augment=True)
    provenance = {
        "program": f"uika-drjit {__version__}",
        "training": json.dumps(asdict(config)),
        "step": str(step),
        "head": head.id,
    }
    save_estimator(path, config.architecture, copy.state_dict(), provenance)
    return plain | {f"hard_{name}": value for name, value in hard.items()}


@torch.no_grad()
def _follow(mean: dict[str, Tensor], network: nn.Module, keep: float) -> None:
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            mean[name].lerp_(value, 1 - keep)
        else:
            mean[name].copy_(value)


def _save(
    path: Path,
    config: SurfaceTraining,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    mean: dict[str, Tensor],
    step: int,
) -> None:
    state = {f"network.{name}": value for name, value in network.state_dict().items()}
    state |= {f"mean.{name}": value for name, value in mean.items()}
    for name, parameter in network.named_parameters():
        for moment in ("exp_avg", "exp_avg_sq"):
            state[f"{moment}.{name}"] = optimizer.state[parameter][moment]
    header = {"step": str(step), "config": json.dumps(asdict(config))}
    write_tensors(path, {name: value.detach().contiguous() for name, value in state.items()}, header)


def _load(
    path: Path, config: SurfaceTraining, network: nn.Module, optimizer: torch.optim.Optimizer, mean: dict[str, Tensor]
) -> int:
    """Put a checkpoint's values in place; returns the number of steps taken.

    Raises:
        UikaError: it is damaged, or of another training.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        stored, step = json.loads(header["config"]), int(header["step"])
        wanted: dict[str, Any] = json.loads(json.dumps(asdict(config)))
        for name, value in wanted.items():
            if name not in _FREE and stored.get(name) != value:
                raise UikaError(
                    f"{path}: was trained with {name} {stored.get(name)}, not {value}; give the same values"
                )
        for name, value in network.state_dict().items():
            value.copy_(state[f"network.{name}"])
            mean[name].copy_(state[f"mean.{name}"])
        for name, parameter in network.named_parameters():
            moments = {moment: state[f"{moment}.{name}"] for moment in ("exp_avg", "exp_avg_sq")}
            optimizer.state[parameter] = {"step": torch.tensor(float(step)), **moments}
    except (OSError, SafetensorError, LookupError, ValueError) as error:
        raise UikaError(f"{path}: cannot be read as a checkpoint; remove it to begin again ({error})") from error
    return step
