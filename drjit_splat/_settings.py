"""The arguments of one call that are not arrays; nothing here needs torch."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, field, fields
from typing import Any

from . import constants as c

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
SEMANTICS = ("gsplat", "inria")
CAMERA_MODELS = ("pinhole", "ortho", "fisheye")


@dataclass(frozen=True)
class Options:
    """Accuracy and skips of the kernels; the defaults are what users of gsplat expect.

    Attributes:
        alpha_min: pairs of lower opacity are skipped; also bounds every splat's footprint. In [1e-6, 0.5].
        transmittance_min: a pixel stops before the splat that would bring its transmittance down to this.
        exp_degree: degree 3, 4 or 5 of the polynomial for 2**x; relative errors 1e-4, 4e-6 and 1e-7.
        exact_tiles: list only the tiles that a splat's ellipse reaches, not its whole bounding box.
        opacity_extent: let a faint splat's footprint shrink; otherwise all reach as far as an opaque one.
        stop_early: leave a tile's list once all its pixels have stopped.
        list_width: 4x4 tiles, side by side, that share a list: 1, 2 or 4. More make the lists sooner and blend later.
        cull_offscreen: drop splats whose footprint misses the image before they are sorted.
        count_skips: add `box_pairs` and `empty_tiles` to `meta["n_culled"]`.
        bridge: what carries arrays between torch and Dr.Jit: "wrap" for `drjit.wrap`, or "direct" without it.

    No switch changes the image beyond its rounding, except the first three.
    """

    alpha_min: float = c.ALPHA_MIN
    transmittance_min: float = c.T_MIN
    exp_degree: int = 5
    exact_tiles: bool = True
    opacity_extent: bool = True
    stop_early: bool = True
    list_width: int = 1
    cull_offscreen: bool = True
    count_skips: bool = False
    bridge: str = "wrap"

    def __post_init__(self) -> None:
        """Raise ValueError naming the first value out of range."""
        if not 1e-6 <= self.alpha_min <= 0.5:
            raise ValueError(f"alpha_min must lie in [1e-6, 0.5], not {self.alpha_min}")
        if not 1e-30 <= self.transmittance_min < 1:
            raise ValueError(f"transmittance_min must lie in [1e-30, 1), not {self.transmittance_min}")
        if self.exp_degree not in (3, 4, 5):
            raise ValueError(f"exp_degree must be 3, 4 or 5, not {self.exp_degree!r}")
        if self.list_width not in (1, 2, 4):
            raise ValueError(f"list_width must be 1, 2 or 4, not {self.list_width!r}")
        if self.bridge not in ("wrap", "direct"):
            raise ValueError(f"bridge must be wrap or direct, not {self.bridge!r}")


@dataclass(frozen=True)
class Settings:
    """Sizes, limits and modes of one call."""

    width: int
    height: int
    near_plane: float = 0.01
    far_plane: float = 1e10
    radius_clip: float = 0.0
    eps2d: float = 0.3
    sh_degree: int | None = None
    render_mode: str = "RGB"
    rasterize_mode: str = "classic"
    semantics: str = "gsplat"
    options: Options = field(default_factory=Options)
    camera_model: str = "pinhole"
    closing: bool = False  # the splat at which a pixel stops gets all that is left; the adjoint knows nothing of it

    @classmethod
    def of(cls, width: Any, height: Any, options: Options | None = None, **arguments: Any) -> Settings:
        """Checked settings; `arguments` are further fields by name.

        Raises:
            ValueError: a value is not allowed.
            TypeError: a name is not that of a field.
        """
        unknown = set(arguments) - {f.name for f in fields(cls)} | {"closing"} & set(arguments)
        if unknown:
            raise TypeError(f"got an unexpected keyword argument {min(unknown)!r}")
        width, height = _integer("width", width), _integer("height", height)
        if arguments.get("sh_degree") is not None:
            arguments["sh_degree"] = _integer("sh_degree", arguments["sh_degree"])
        settings = cls(width, height, **arguments, options=options or Options())
        settings.check()
        return settings

    @property
    def has_colors(self) -> bool:
        """Whether colour channels are rendered."""
        return self.render_mode.startswith("RGB")

    @property
    def has_depth(self) -> bool:
        """Whether a depth channel is rendered (last)."""
        return self.render_mode != "RGB"

    @property
    def expected_depth(self) -> bool:
        """Whether the depth channel is divided by the coverage."""
        return self.render_mode.endswith("ED")

    @property
    def antialiased(self) -> bool:
        """Whether opacities are scaled to undo the area that the low-pass adds."""
        return self.rasterize_mode == "antialiased"

    @property
    def inria(self) -> bool:
        """Whether the original 3DGS rasterizer's rules replace gsplat's."""
        return self.semantics == "inria"

    @property
    def alpha_max(self) -> float:
        """Where a pair's opacity is held."""
        return c.ALPHA_MAX_INRIA if self.inria else c.ALPHA_MAX

    @property
    def near(self) -> float:
        """Depth up to which splats are culled."""
        return max(self.near_plane, c.NEAR_INRIA) if self.inria else self.near_plane

    def check(self) -> None:
        """Raise ValueError naming the first argument whose value is not allowed."""
        for name, size in (("width", self.width), ("height", self.height)):
            if not 1 <= size <= 65536:
                raise ValueError(f"{name} must be an integer from 1 to 65536, not {size!r}")
        if not 0 <= self.near_plane < self.far_plane:
            raise ValueError(f"near_plane must be >= 0 and below far_plane, not {self.near_plane} and {self.far_plane}")
        for name, value in (("eps2d", self.eps2d), ("radius_clip", self.radius_clip)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number >= 0, not {value}")
        for name, chosen, allowed in (
            ("render_mode", self.render_mode, RENDER_MODES),
            ("rasterize_mode", self.rasterize_mode, RASTERIZE_MODES),
            ("semantics", self.semantics, SEMANTICS),
            ("camera_model", self.camera_model, CAMERA_MODELS),
        ):
            if chosen not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, not {chosen!r}")
        if self.sh_degree not in (None, 0, 1, 2, 3, 4):
            raise ValueError(f"sh_degree must be None or 0 to 4, not {self.sh_degree!r}")
        if self.inria and self.camera_model != "pinhole":
            raise ValueError(f'camera_model must be pinhole with semantics="inria", not {self.camera_model!r}')


def _integer(name: str, value: Any) -> int:
    """A Python integer of any kind of integer: numpy's, or a tensor with one element."""
    try:
        if isinstance(value, bool):
            raise TypeError
        return operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be an integer, not {value!r}") from None
