"""A run's state on disk: safetensors, never a pickle, and only whole under its name."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from .config import TrainConfig

NAME = "checkpoint.safetensors"
FORMAT = "drjit-splat training 1"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a run needs to go on as if it had never been stopped."""

    step: int  # steps done
    seconds: float  # time spent
    config: TrainConfig
    tensors: dict[str, Tensor]  # "param/NAME", "adam/NAME/MOMENT", "state/NAME"


def save(folder: Path, checkpoint: Checkpoint) -> None:
    """Write the checkpoint in place of the last one."""
    known = {"step": checkpoint.step, "seconds": checkpoint.seconds, "config": asdict(checkpoint.config)}
    target, temporary = folder / NAME, folder / f".{NAME}.{secrets.token_hex(4)}"
    try:
        tensors = {name: value.detach().contiguous().clone() for name, value in checkpoint.tensors.items()}
        save_file(tensors, temporary, {"format": FORMAT, "run": json.dumps(known)})
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def load(folder: Path) -> Checkpoint | None:
    """The last checkpoint of a run; None if there is none.

    Raises:
        ValueError: it is damaged or no checkpoint; the message names the file.
    """
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        with safe_open(path, "pt") as file:
            header: Mapping[str, str] = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise ValueError("it is no checkpoint of this program")
            known: Any = json.loads(header["run"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        config = TrainConfig.of(known["config"])
        return Checkpoint(int(known["step"]), float(known["seconds"]), config, tensors)
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: cannot be gone on from ({error}); remove it to begin anew") from None


def optimizer_tensors(optimizers: Mapping[str, torch.optim.Optimizer]) -> dict[str, Tensor]:
    """Adam's moments and counts by parameter."""
    found: dict[str, Tensor] = {}
    for name, optimizer in optimizers.items():
        for state in optimizer.state.values():
            found |= {f"adam/{name}/{key}": value for key, value in state.items() if isinstance(value, Tensor)}
    return found


def restore_optimizers(optimizers: Mapping[str, torch.optim.Optimizer], tensors: Mapping[str, Tensor]) -> None:
    """Put back what `optimizer_tensors` gave."""
    for name, optimizer in optimizers.items():
        prefix = f"adam/{name}/"
        state = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
        if state:
            optimizer.state[optimizer.param_groups[0]["params"][0]] = dict(state)
