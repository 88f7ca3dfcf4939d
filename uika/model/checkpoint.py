"""Model files: safetensors with the configuration in the header, never a pickle."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.overrides import TorchFunctionMode

from uika.io.files import write_tensors
from uika.model.config import PRESETS, ModelConfig
from uika.model.reconstructor import Reconstructor

FORMAT = "uika-model"
VERSION = "1"
_LISTED = 20


class CheckpointError(ValueError):
    """A model file that cannot be used; the message names the file and what is wrong with it."""


def build(preset: str | ModelConfig, seed: int = 0) -> Reconstructor:
    """An untrained model, the same for the same seed; leaves the global generator as it was.

    `preset` is a name from `PRESETS` or a config. Raises ValueError for an unknown name.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise ValueError(f"unknown preset {preset!r}: choose from {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Reconstructor(preset)


def save_checkpoint(
    path: str | Path,
    model: Reconstructor,
    dtype: torch.dtype | None = None,
    provenance: Mapping[str, str] | None = None,
) -> None:
    """Write weights and config; the file appears under its name only when it is complete.

    `dtype` (for example torch.bfloat16) converts the weights on the way; `provenance` is kept in the header.
    """
    weights = dict(model.named_parameters())
    tensors = {}
    for name, value in model.state_dict().items():
        # Buffers hold rotary periods, whose angles suffer from rounding.
        value = value.to(dtype) if dtype is not None and name in weights else value
        tensors[name] = value.detach().cpu().contiguous()
    metadata = {
        "format": FORMAT,
        "version": VERSION,
        "config": json.dumps(model.config.to_dict()),
        "provenance": json.dumps(dict(provenance or {})),
    }
    write_tensors(path, tensors, metadata)


def load_checkpoint(path: str | Path) -> Reconstructor:
    """Read a model written by `save_checkpoint`; weights are float32 on the CPU, the model is in eval mode.

    Raises CheckpointError for a file that is missing, truncated, of another format or version, or whose tensors do
    not fit its config.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such model file")
    config, tensors = _read(path)
    try:
        with torch.random.fork_rng(devices=[]), _Uninitialised():
            model = Reconstructor(config)
    except (LookupError, TypeError, ValueError, RuntimeError, ArithmeticError) as error:
        raise CheckpointError(f"{path}: its config describes no model ({error})") from error
    expected = model.state_dict()
    if problems := misfits(tensors, expected):
        raise CheckpointError(f"{path}: tensors do not fit the config: {problems}")
    model.load_state_dict(tensors, assign=True)
    return model.eval()


def _read(path: Path) -> tuple[ModelConfig, dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CheckpointError(f"{path}: not a {FORMAT} file (format {metadata.get('format', 'unknown')!r})")
            if metadata.get("version") != VERSION:
                raise CheckpointError(
                    f"{path}: version {metadata.get('version', 'unknown')} of the format, this program reads {VERSION}"
                )
            config = ModelConfig.from_dict(json.loads(metadata["config"]))
            check_depth(path, config.layers + config.backbone.depth, len(file.keys()))
            return config, {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CheckpointError(f"{path}: damaged or truncated safetensors file ({error})") from error
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        raise CheckpointError(f"{path}: unreadable config in the header ({error})") from error


def check_depth(path: str | Path, blocks: int, tensors: int) -> None:
    """Refuse a config of more blocks than its file has tensors, before they are built.

    Raises:
        CheckpointError: it names the file.
    """
    if blocks > tensors:
        raise CheckpointError(f"{path}: its config speaks of {blocks} blocks, but the file holds {tensors} tensors")


def misfits(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], unused: Sequence[str] = ()) -> str:
    """What keeps a file's tensors from being a model's, in one line; empty if nothing does."""
    shapes = [
        f"{name} {list(tensors[name].shape)} instead of {list(value.shape)}"
        for name, value in expected.items()
        if name in tensors and tensors[name].shape != value.shape
    ]
    problems = (
        listing("missing", [name for name in expected if name not in tensors]),
        listing("unknown", [name for name in tensors if name not in expected and name not in unused]),
        listing("misshapen", shapes),
    )
    return "; ".join(filter(None, problems))


def listing(kind: str, names: list[str]) -> str:
    """One phrase that names the first of many; empty for none."""
    if not names:
        return ""
    rest = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{kind}: {', '.join(names[:_LISTED])}{rest}"


class _Uninitialised(TorchFunctionMode):
    """Leaves memory as it was allocated where `torch.nn.init` would draw: the file's weights take its place.

    The meta device would do so too, but loads torch's compiler, which takes a second.
    """

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if getattr(func, "__module__", "") == "torch.nn.init":
            return args[0] if args else (kwargs or {})["tensor"]
        return func(*args, **(kwargs or {}))
