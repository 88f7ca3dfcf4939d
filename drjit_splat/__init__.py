"""Differentiable Gaussian splatting on Dr.Jit, with torch gradients."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from . import reference
    from ._compat import rasterization_2dgs
    from ._harmonics import sh_colors
    from ._settings import Options
    from .files import load_splats
    from .frames import Frame, ProjectedFrame, project_frame
    from .ply import SplatFile, load_ply, save_ply
    from .prepared import Prepared, prepare
    from .profiling import profile
    from .rasterizer import rasterization
    from .sog import load_sog
    from .splat import load_splat, save_splat
    from .spz import load_spz, save_spz

_HOMES = {
    "Frame": "frames",
    "Options": "_settings",
    "Prepared": "prepared",
    "ProjectedFrame": "frames",
    "SplatFile": "ply",
    "load_ply": "ply",
    "load_sog": "sog",
    "load_splat": "splat",
    "load_splats": "files",
    "load_spz": "spz",
    "prepare": "prepared",
    "profile": "profiling",
    "project_frame": "frames",
    "rasterization": "rasterizer",
    "rasterization_2dgs": "_compat",
    "save_ply": "ply",
    "save_splat": "splat",
    "save_spz": "spz",
    "sh_colors": "_harmonics",
}

__all__ = [
    "Frame",
    "Options",
    "Prepared",
    "ProjectedFrame",
    "SplatFile",
    "__version__",
    "load_ply",
    "load_sog",
    "load_splat",
    "load_splats",
    "load_spz",
    "prepare",
    "profile",
    "project_frame",
    "rasterization",
    "rasterization_2dgs",
    "reference",
    "save_ply",
    "save_splat",
    "save_spz",
    "sh_colors",
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
