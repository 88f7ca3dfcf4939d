"""Checkpoints of a training: everything that the next step depends on, in safetensors written by all processes."""

from __future__ import annotations

import json
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.distributed.checkpoint as dcp
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.distributed.checkpoint.api import CheckpointException

from uika.errors import UikaError
from uika.train.config import TrainConfig
from uika.train.optimiser import RunningMean, trained
from uika.train.parallel import Group

_PROGRESS = "progress.json"
_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Progress:
    """Where a training stands."""

    step: int = 0  # steps taken, skipped ones included
    updates: int = 0  # steps that changed the weights
    cursor: int = 0  # heads drawn


class Checkpoints:
    """The checkpoints of a run: written whole under a new name, the last ones kept."""

    def __init__(self, folder: Path, keep: int, group: Group) -> None:
        """`folder` is made when the first is written."""
        self._folder, self._keep, self._group = folder, keep, group

    def save(
        self,
        progress: Progress,
        config: TrainConfig,
        network: nn.Module,
        optimizer: torch.optim.Optimizer,
        mean: RunningMean,
    ) -> Path:
        """Write a checkpoint; one of that step that is already there is replaced.

        Raises:
            UikaError: it cannot be written, for example because the disk is full.
        """
        target = self._folder / f"step-{progress.step:08d}"
        partial = self._folder / f".{target.name}.partial"
        try:
            self._write(partial, target, progress, config, _state(network, optimizer, mean))
        except CheckpointException as error:
            reason = next(iter(error.failures.values()))[0]
            raise UikaError(f"{target}: cannot be written ({reason})") from error
        finally:
            if self._group.first:
                shutil.rmtree(partial, ignore_errors=True)
        self._group.wait()
        return target

    def _write(
        self, partial: Path, target: Path, progress: Progress, config: TrainConfig, state: dict[str, Tensor]
    ) -> None:
        if self._group.first:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
        self._group.wait()
        state |= {f"random.{self._group.rank}": torch.get_rng_state()}
        writer = dcp.HuggingFaceStorageWriter(str(partial), save_distributed=True)
        with _single_process_is_fine():
            dcp.save(state, storage_writer=writer, no_dist=not dist.is_initialized())
        self._group.wait()
        if self._group.first:
            sizes = {path.name: path.stat().st_size for path in partial.glob("*.safetensors")}
            content = {**asdict(progress), "config": config.to_dict(), "files": sizes}
            (partial / _PROGRESS).write_text(json.dumps(content, indent=1))
            shutil.rmtree(target, ignore_errors=True)
            partial.rename(target)
            for old in self._sorted()[: -self._keep]:
                shutil.rmtree(old, ignore_errors=True)

    def latest(self) -> Path | None:
        """The newest checkpoint whose files are whole; damaged ones are named on stderr and left alone."""
        step = -1
        if self._group.first:
            for folder in reversed(self._sorted()):
                if problem := _problem(folder):
                    print(f"{folder}: {problem}; using the one before", file=sys.stderr)
                    continue
                step = int(folder.name.removeprefix("step-"))
                break
        step = self._group.shared(step)
        return None if step < 0 else self._folder / f"step-{step:08d}"

    def load(self, folder: Path, network: nn.Module, optimizer: torch.optim.Optimizer, mean: RunningMean) -> Progress:
        """Put a checkpoint's values into the network, the optimiser, the running mean and torch's generator."""
        content = read_progress(folder)
        progress = Progress(content["step"], content["updates"], content["cursor"])
        _fill_moments(network, optimizer, progress.updates)
        state = _state(network, optimizer, mean)
        reader = dcp.HuggingFaceStorageReader(str(folder))
        stored = reader.read_metadata().state_dict_metadata
        missing = sorted(set(state) - set(stored))
        if missing:
            raise UikaError(f"{folder}: lacks {missing[0]} and {len(missing) - 1} more; it is of another model")
        name = f"random.{self._group.rank}"
        if name in stored:  # not after a change of the number of processes
            state[name] = torch.get_rng_state()
        with _single_process_is_fine():
            dcp.load(state, storage_reader=reader, no_dist=not dist.is_initialized())
        if name in stored:
            torch.set_rng_state(state[name])
        return progress

    def _sorted(self) -> list[Path]:
        return sorted(path for path in self._folder.glob("step-*") if path.is_dir())


def read_progress(folder: Path) -> dict[str, Any]:
    """The description of a checkpoint.

    Raises:
        UikaError: it cannot be read.
    """
    try:
        return json.loads((folder / _PROGRESS).read_text())
    except (OSError, ValueError) as error:
        raise UikaError(f"{folder / _PROGRESS}: cannot be read ({error})") from error


@contextmanager
def _single_process_is_fine() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "torch.distributed is disabled", UserWarning)
        yield


def _state(network: nn.Module, optimizer: torch.optim.Optimizer, mean: RunningMean) -> dict[str, Tensor]:
    """All tensors by name; they share memory with their owners."""
    state: dict[str, Tensor] = {f"model.{name}": value.detach() for name, value in network.state_dict().items()}
    state |= {f"mean.{name}": value for name, value in mean.values.items()}
    for name, parameter in trained(network).items():
        moments = optimizer.state.get(parameter, {})
        state |= {f"optimizer.{name}.{moment}": moments[moment] for moment in _MOMENTS if moment in moments}
    return state


def _fill_moments(network: nn.Module, optimizer: torch.optim.Optimizer, updates: int) -> None:
    """Make the optimiser's state, as it would be after its first step, for a checkpoint to be read into."""
    if updates == 0:
        return
    for parameter in trained(network).values():
        moments = {moment: torch.zeros_like(parameter) for moment in _MOMENTS}
        optimizer.state[parameter] = {"step": torch.tensor(float(updates)), **moments}


def _problem(folder: Path) -> str:
    """What is wrong with a checkpoint's files; empty for nothing."""
    try:
        files = read_progress(folder)["files"]
        for name, size in files.items():
            if (folder / name).stat().st_size != size:
                return f"{name} is truncated"
            with safe_open(folder / name, framework="pt"):
                pass
    except (UikaError, OSError, KeyError, SafetensorError) as error:
        return f"is damaged ({error})"
    return ""
