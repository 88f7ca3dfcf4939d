"""Model files for use, out of a training."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from uika._version import __version__
from uika.io.files import write_tensors
from uika.model import CheckpointError, Estimator, EstimatorConfig, Reconstructor, load_checkpoint, save_checkpoint
from uika.model.checkpoint import check_depth
from uika.model.config import BackboneConfig, ModelConfig
from uika.train.checkpoint import Progress
from uika.train.config import TrainConfig
from uika.train.optimiser import RunningMean
from uika.train.parallel import Group
from uika.train.tasks import Task

ESTIMATOR_FORMAT = "uika-estimator"
_VERSION = "1"


def export(path: Path, task: Task, mean: RunningMean, config: TrainConfig, progress: Progress, group: Group) -> None:
    """Write the running mean of the weights as a model file, in bfloat16.

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
    }
    if isinstance(task.model, Reconstructor):
        copy = Reconstructor(_in_use(task.model.config, config.finished))
        copy.load_state_dict(state)
        save_checkpoint(path, copy, torch.bfloat16, provenance)
    elif isinstance(task.model, Estimator):
        _save_estimator(path, task.model.config, state, provenance)


def load_start(task: Task, path: Path) -> None:
    """Give a task's network the weights of a model file.

    Raises:
        CheckpointError: the file cannot be read, or is of another architecture.
    """
    stored = load_checkpoint(path) if isinstance(task.model, Reconstructor) else load_estimator(path)
    try:
        task.model.load_state_dict(stored.state_dict())
    except RuntimeError as error:
        raise CheckpointError(f"{path}: is a model of another architecture than the training's") from error


def load_estimator(path: str | Path) -> Estimator:
    """Read an estimator that a training wrote; weights are float32 on the CPU, the model is in eval mode.

    Raises:
        CheckpointError: the file is missing, damaged or of another kind.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != ESTIMATOR_FORMAT or header.get("version") != _VERSION:
                raise CheckpointError(f"{path}: not a {ESTIMATOR_FORMAT} file of version {_VERSION}")
            config = json.loads(header["config"])
            backbone = BackboneConfig(**_tuples(config.pop("backbone")))
            check_depth(path, backbone.depth + config.get("layers", 0), len(file.keys()))
            with torch.device("meta"):
                model = Estimator(EstimatorConfig(backbone=backbone, **_tuples(config)))
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
            model.load_state_dict(tensors, assign=True)
    except CheckpointError:
        raise
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: cannot be read as an estimator ({error})") from error
    return model.eval()


def _in_use(trained: ModelConfig, finished: ModelConfig) -> ModelConfig:
    """A trained architecture with the values that differ between training and use."""
    gaussians = dataclasses.replace(trained.gaussians, least_scale=finished.gaussians.least_scale)
    return dataclasses.replace(trained, map_size=finished.map_size, detail=finished.detail, gaussians=gaussians)


def _save_estimator(path: Path, config: EstimatorConfig, state: dict[str, Tensor], provenance: dict[str, str]) -> None:
    header = {
        "format": ESTIMATOR_FORMAT,
        "version": _VERSION,
        "config": json.dumps(dataclasses.asdict(config)),
        "provenance": json.dumps(provenance),
    }
    exact = ("periods", "bias_mask")  # rounding would turn angles
    tensors = {
        name: (value if name.endswith(exact) else value.to(torch.bfloat16)).contiguous()
        for name, value in state.items()
    }
    write_tensors(path, tensors, header)


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _gathered(tensor: Tensor) -> Tensor:
    whole = tensor.full_tensor() if hasattr(tensor, "full_tensor") else tensor
    return whole.detach()
