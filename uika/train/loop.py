"""The training loop."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from uika.data.datasets import People
from uika.errors import UikaError
from uika.head import HeadModel, load_head
from uika.metrics.lpips import Lpips
from uika.model import computes_bfloat16
from uika.model.dinov3 import load_backbone
from uika.model.estimator_file import check_estimator_head, read_estimator
from uika.train.batches import batches_of
from uika.train.checkpoint import Checkpoints, Progress, read_progress
from uika.train.config import TrainConfig
from uika.train.dataset import ItemMaker
from uika.train.export import export, load_start
from uika.train.item import Item
from uika.train.logbook import Clock, Logbook
from uika.train.optimiser import RunningMean, learning_rate, make_optimizer
from uika.train.parallel import Group, Sharding, distribute
from uika.train.prepared import PreparedItems
from uika.train.requirements import backbone_of, check_start, file_digest, summary
from uika.train.sampler import Sampler, SamplerConfig
from uika.train.tasks import Task, blocks, judge, make_task, recompute_activations

MODEL_FILE = "model.safetensors"
_FREE = ("steps", "save_every", "keep", "histogram_every", "patience")  # may change when a run is continued


@dataclass(frozen=True)
class Setup:
    """How to run a training, apart from what is trained."""

    output: Path
    workers: int = 1  # processes that make items; 0 makes them in the trainer itself
    resume: bool = False
    overfit: int = 0  # heads that every step sees, to see whether training works at all; 0 for all people
    sharding: Sharding = "ddp"
    lpips: Path | None = None
    backbone: Path | None = None  # weights of the frozen backbone; a model to start from and a checkpoint have them
    estimator: Path | None = None  # finds the correspondence of photos in the place of exact and fitted ones
    init: Path | None = None  # a model file whose weights a new training starts from
    items: Path | None = None  # folder of prepared items; what is missing there is made and kept
    progress: bool = True


class TrainingError(UikaError):
    """A training that cannot go on."""


def train(config: TrainConfig, people: People, setup: Setup, group: Group, head: HeadModel | None = None) -> Path:
    """Train until `config.steps` and write `model.safetensors` into the run's folder.

    Args:
        config: what to train and how.
        people: the data.
        setup: where, and with which help.
        group: this process among those that train together.
        head: the head model; None loads the one that `uika.head.load_head` finds. Items are made with that one.

    Returns:
        The model file.

    Raises:
        TrainingError: too many steps in a row were not finite.
        UikaError: the run's folder holds another training, or nothing to resume.
    """
    head = (load_head() if head is None else head).without_bust
    if setup.estimator is not None:
        config = replace(config, estimator=file_digest(setup.estimator))
    checkpoints = Checkpoints(setup.output / "checkpoints", config.keep, group)
    latest = _latest(checkpoints, config, setup)
    check_start(config, setup.backbone, has_weights=setup.init is not None or latest is not None)
    estimator = None
    if setup.estimator is not None:
        check_estimator_head(setup.estimator, head)
        estimator = read_estimator(setup.estimator)
    task = make_task(config, head, None if setup.lpips is None else Lpips(setup.lpips), estimator)
    if setup.init is not None:
        load_start(task, setup.init)
    if setup.backbone is not None:
        load_backbone(backbone_of(task.model), setup.backbone)
    task.network.to(group.device).train()
    if config.checkpointing:
        recompute_activations(task)
    network = distribute(task.network, blocks(task.model), group, setup.sharding)
    optimizer = make_optimizer(task.network, config)
    mean = RunningMean(task.network, config.ema)
    progress = Progress() if latest is None else checkpoints.load(latest, task.network, optimizer, mean)
    sampler_config = SamplerConfig(
        people=len(people),
        seed=config.seed,
        most_sources=config.sources,
        images=max(config.images, setup.overfit),
        most_items=setup.overfit or config.items,
        fixed=setup.overfit > 0,
    )
    if setup.overfit:
        sampler_config = replace(sampler_config, most_sources=1)
    sampler = Sampler(sampler_config, group.rank, group.size, progress.step, progress.cursor)
    book = Logbook(setup.output, progress.step, config.steps, setup.progress) if group.first else None
    if book is not None:
        files = {"backbone": setup.backbone, "estimator": setup.estimator, "lpips": setup.lpips, "init": setup.init}
        for line in summary(config, task.model, head, files):
            book.say(line)
        if latest is not None:
            book.say(f"resumed: {latest}, step {progress.step:,}")
    trainer = _Trainer(config, task, network, optimizer, mean, group, book)
    maker = ItemMaker(people, config) if setup.items is None else PreparedItems(setup.items, people, config)
    batches = batches_of(maker, sampler, config.steps - progress.step, setup.workers)
    try:
        while progress.step < config.steps:
            progress = trainer.step(batches, progress, sampler)
            if progress.step % config.save_every == 0 or progress.step == config.steps:
                checkpoints.save(progress, config, task.network, optimizer, mean)
                export(setup.output / MODEL_FILE, task, mean, config, progress, group, head)
    finally:
        if book is not None:
            book.close()
    return setup.output / MODEL_FILE


class _Trainer:
    """Steps of one training."""

    def __init__(
        self,
        config: TrainConfig,
        task: Task,
        network: nn.Module,
        optimizer: torch.optim.Optimizer,
        mean: RunningMean,
        group: Group,
        book: Logbook | None,
    ) -> None:
        self._config, self._task, self._network = config, task, network
        self._optimizer, self._mean, self._group, self._book = optimizer, mean, group, book
        self._clock = Clock(group.device)
        self._failures = 0
        self._said: set[str] = set()  # notes on the data

    def step(self, batches: Iterator[list[Item]], progress: Progress, sampler: Sampler) -> Progress:
        """Take one step; one that is not finite leaves the weights alone."""
        clock, config = self._clock, self._config
        with clock.stage("data"):
            items = [item.to(self._group.device) for item in next(batches)]
        self._note(items)
        rate = learning_rate(progress.step, config.learning_rate, config.warmup, config.steps)
        values, outputs = self._gradients(items)
        with clock.stage("optimiser"):
            parameters = [p for p in self._task.network.parameters() if p.requires_grad]
            norm = float(_whole(nn.utils.clip_grad_norm_(parameters, config.clip)))
            skip = self._group.any(not math.isfinite(values["loss"] + norm))
            if not skip:
                for options in self._optimizer.param_groups:
                    options["lr"] = rate
                self._optimizer.step()
                self._mean.update(self._task.network, progress.updates)
            self._optimizer.zero_grad(set_to_none=True)
        self._finish(progress, values, {"learning_rate": rate, "gradient_norm": norm}, items, outputs, skip)
        return Progress(
            progress.step + 1, progress.updates + (not skip), sampler.advance(progress.step, progress.cursor)
        )

    def _gradients(self, items: list[Item]) -> tuple[dict[str, float], list[tuple[Tensor, ...]]]:
        """Losses and the gradients of all parameters.

        The graph is cut between network and pictures: pictures of one item are gone before those of the next are made.
        """
        clock = self._clock
        with clock.stage("network"), self._arithmetic():
            outputs = self._network(items)
        sums: dict[str, float] = {}
        gradients: list[Tensor] = []
        for output, item in zip(outputs, items, strict=True):
            leaves = tuple(tensor.detach().requires_grad_() for tensor in output)
            with clock.stage("splat"):
                judged = judge(self._task, leaves, item)
            with clock.stage("splat_backward"):
                if bool(torch.isfinite(judged.loss)):
                    (judged.loss / len(items)).backward()
            for name, value in {"loss": float(judged.loss.detach()), **judged.terms}.items():
                sums[name] = sums.get(name, 0.0) + value / len(items)
            gradients += [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
        with clock.stage("network_backward"):
            # Also when the loss is not finite: with several processes all must come by here.
            tensors = [tensor for output in outputs for tensor in output]
            learned = [pair for pair in zip(tensors, gradients, strict=True) if pair[0].requires_grad]
            torch.autograd.backward([tensor for tensor, _ in learned], [gradient for _, gradient in learned])
        return sums, outputs

    def _finish(
        self,
        progress: Progress,
        values: dict[str, float],
        more: dict[str, float],
        items: list[Item],
        outputs: list[tuple[Tensor, ...]],
        skip: bool,
    ) -> None:
        """Record the step; stop after too many steps in a row whose numbers were not finite."""
        step, seconds = progress.step, self._clock.take()
        self._failures = self._failures + 1 if skip else 0
        if skip:
            keys = [key for item in items for key in item.keys]
            if self._book is not None:
                self._book.skipped(step, values["loss"], keys)
            if self._failures >= self._config.patience:
                raise TrainingError(
                    f"{self._failures} steps in a row were not finite, the last with images {', '.join(keys)}; "
                    "lower learning_rate or remove these images, then go on with --resume"
                )
            return
        values = self._group.mean(values)
        if self._book is not None:
            self._book.step(step, values | more, seconds, len(items) * self._group.size)
            if step % self._config.histogram_every == 0:
                self._book.histograms(step, self._task.measures(outputs[0]))

    def _arithmetic(self) -> AbstractContextManager[Any]:
        device, wanted = self._group.device, self._config.precision
        if wanted == "bfloat16" or (wanted == "auto" and computes_bfloat16(device)):
            return torch.autocast(device.type, torch.bfloat16)
        return nullcontext()

    def _note(self, items: list[Item]) -> None:
        for note in dict.fromkeys(note for item in items for note in item.notes):
            if note not in self._said and self._book is not None:
                self._book.say(note)
            self._said.add(note)


def _latest(checkpoints: Checkpoints, config: TrainConfig, setup: Setup) -> Path | None:
    """The checkpoint to go on from, if there is one and it is of this training.

    Raises:
        UikaError: the folder holds another training, or one that was not asked to go on.
    """
    latest = checkpoints.latest()
    if latest is None:
        return None
    if not setup.resume:
        raise UikaError(f"{setup.output}: already holds a training; add --resume to go on, or choose another folder")
    stored, wanted = read_progress(latest)["config"], json.loads(json.dumps(config.to_dict()))
    for name, value in wanted.items():
        if name not in _FREE and stored.get(name) != value:
            raise UikaError(
                f"{latest}: was trained with {name} {stored.get(name)}, not {value}; give the same values to resume"
            )
    return latest


def _whole(tensor: Tensor) -> Tensor:
    """A tensor whose parts may lie with several processes."""
    return tensor.full_tensor() if hasattr(tensor, "full_tensor") else tensor
