"""Scenes from photos with known cameras: reading data sets, training splats, and going on where a run was stopped."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .captures import Capture, Photo
    from .config import TrainConfig
    from .datasets import open_capture
    from .loop import Progress, train

_HOMES = {
    "Capture": "captures",
    "Photo": "captures",
    "Progress": "loop",
    "TrainConfig": "config",
    "open_capture": "datasets",
    "train": "loop",
}

__all__ = ["Capture", "Photo", "Progress", "TrainConfig", "open_capture", "train"]


def __getattr__(name: str) -> Any:
    # The command line shows its options without waiting for torch.
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
