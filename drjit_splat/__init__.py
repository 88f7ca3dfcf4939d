"""Differentiable Gaussian splatting on Dr.Jit, with torch gradients."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import reference
    from ._settings import Options
    from .ply import SplatFile, load_ply, save_ply
    from .prepared import Prepared, prepare
    from .profiling import profile
    from .rasterizer import rasterization

_HOMES = {
    "Options": "_settings",
    "Prepared": "prepared",
    "SplatFile": "ply",
    "load_ply": "ply",
    "prepare": "prepared",
    "profile": "profiling",
    "rasterization": "rasterizer",
    "save_ply": "ply",
}

__all__ = [
    "Options",
    "Prepared",
    "SplatFile",
    "load_ply",
    "prepare",
    "profile",
    "rasterization",
    "reference",
    "save_ply",
]


def __getattr__(name: str) -> Any:
    # Loading torch and Dr.Jit takes longer than looking at a name should.
    if name == "reference":
        return import_module(".reference", __name__)
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
