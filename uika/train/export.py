"""Model files for use, out of a training."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import torch
from torch import Tensor

from uika._version import __version__
from uika.head import HeadModel
from uika.model import CheckpointError, Estimator, Reconstructor, load_checkpoint, save_checkpoint
from uika.model.config import ModelConfig
from uika.model.estimator_file import AnyEstimator, read_estimator, save_estimator
from uika.model.weight_kind import check_kind
from uika.train.checkpoint import Progress
from uika.train.config import TrainConfig
from uika.train.optimiser import RunningMean
from uika.train.parallel import Group
from uika.train.tasks import Task


def export(
    path: Path, task: Task, mean: RunningMean, config: TrainConfig, progress: Progress, group: Group, head: HeadModel
) -> None:
    """Write the running mean of the weights, trained on a head model, as a model file, in bfloat16.

    All processes must call it, since each may hold a part of the weights; the first one writes.
    """
    weights = {name: _gathered(value) for name, value in mean.values.items()}
    rest = {name: _gathered(value) for name, value in task.network.state_dict().items() if name not in weights}
    if not group.first:
        return
    state = {name.removeprefix("model."): value.cpu() for name, value in (weights | rest).items()}
    provenance = {
        "program": f"uika-drjit {__version__}",
        "training": json.dumps(config.to_dict()),
        "step": str(progress.step),
        "head": head.id,
    }
    if isinstance(task.model, Reconstructor):
        copy = Reconstructor(_in_use(task.model.config, config.finished))
        copy.load_state_dict(state)
        save_checkpoint(path, copy, torch.bfloat16, provenance)
    elif isinstance(task.model, Estimator):
        save_estimator(path, task.model.config, state, provenance)


def load_start(task: Task, path: Path) -> None:
    """Give a task's network the weights of a model file.

    Raises:
        CheckpointError: the file cannot be read, or is of another architecture.
    """
    stored: Reconstructor | AnyEstimator
    if isinstance(task.model, Reconstructor):
        check_kind(path, ("model",))
        stored = load_checkpoint(path)
    else:
        stored = read_estimator(path)
    try:
        task.model.load_state_dict(stored.state_dict())
    except RuntimeError as error:
        raise CheckpointError(f"{path}: is a model of another architecture than the training's") from error


def _in_use(trained: ModelConfig, finished: ModelConfig) -> ModelConfig:
    """A trained architecture with the values that differ between training and use."""
    gaussians = dataclasses.replace(trained.gaussians, least_scale=finished.gaussians.least_scale)
    return dataclasses.replace(trained, map_size=finished.map_size, detail=finished.detail, gaussians=gaussians)


def _gathered(tensor: Tensor) -> Tensor:
    whole = tensor.full_tensor() if hasattr(tensor, "full_tensor") else tensor
    return whole.detach()
