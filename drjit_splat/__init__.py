"""Differentiable Gaussian splatting on Dr.Jit, with torch gradients."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import reference
    from .rasterizer import rasterization

__all__ = ["rasterization", "reference"]


def __getattr__(name: str) -> Any:
    # Loading torch and Dr.Jit takes longer than looking at a name should.
    if name == "rasterization":
        return import_module(".rasterizer", __name__).rasterization
    if name == "reference":
        return import_module(".reference", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
