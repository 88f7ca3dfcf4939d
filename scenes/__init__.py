"""Mitsuba reference renders of the parametric head; importing this package does not load Mitsuba."""

from scenes.colour import linear_to_srgb, srgb_to_linear
from scenes.exr import read_exr, write_exr, write_png
from scenes.reference_render import AOVS, render
from scenes.splats import register_plugins
from scenes.validation.compare import SplatReport, compare_splats
from scenes.variant import load_mitsuba

__all__ = [
    "linear_to_srgb",
    "srgb_to_linear",
    "AOVS",
    "SplatReport",
    "compare_splats",
    "load_mitsuba",
    "read_exr",
    "register_plugins",
    "render",
    "write_exr",
    "write_png",
]
