"""Arguments that gsplat's function takes and this one does not need."""

from __future__ import annotations

from typing import Any

from ._settings import Options, Settings

_IGNORED = ("channel_chunk", "segmented", "renderer_config")
"""They steer the speed or memory of CUDA kernels, not the image."""

_OF_META = ("packed", "tile_size", "sparse_grad", "absgrad")
"""They change what is told about the splats, where that is told."""

_LENS = "only fisheye lenses may be distorted, by radial_coeffs; undistort the images"
_REFUSED: dict[str, tuple[Any, str]] = {
    "distributed": (False, "one process renders one image; give every process cameras of its own"),
    "with_ut": (False, "the projection is linearised, not an unscented transform"),
    "with_eval3d": (False, "splats are evaluated on the image plane"),
    "tangential_coeffs": (None, _LENS),
    "thin_prism_coeffs": (None, _LENS),
    "ftheta_coeffs": (None, "F-theta lenses are not supported; undistort the images"),
    "viewmats_rs": (None, "rolling shutters are not supported"),
    "return_normals": (False, "splats have no normals"),
    "global_z_order": (True, "splats are ordered by depth along the optical axis"),
    "rays": (None, "only the rays of the camera models are rendered"),
    "lidar_coeffs": (None, "lidars are not supported"),
    "external_distortion_coeffs": (None, "windshields are not supported"),
    "ut_params": (None, "the projection is linearised, not an unscented transform"),
    "extra_signals": (None, "append the signals to the colours"),
    "extra_signals_sh_degree": (None, "append the signals to the colours"),
}


def check_compatibility(arguments: dict[str, Any]) -> None:
    """Accept gsplat's further arguments where they change nothing.

    Raises:
        ValueError: one asks for something that is not available.
        TypeError: a name is not one of gsplat's.
    """
    for name, value in arguments.items():
        if name in _IGNORED:
            continue
        if name == "rolling_shutter":
            if getattr(value, "name", value) not in (None, "GLOBAL"):
                raise ValueError(f"rolling_shutter={value!r} is not available: rolling shutters are not supported")
        elif name not in _REFUSED:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        elif hasattr(value, "shape") or value != _REFUSED[name][0]:
            shown = f"a {type(value).__name__}" if hasattr(value, "shape") else repr(value)
            raise ValueError(f"{name}={shown} is not available: {_REFUSED[name][1]}")


def settings_of(width: Any, height: Any, options: Options | None, arguments: dict[str, Any]) -> Settings:
    """Settings of a call that takes gsplat's further arguments by name and has no meta to fill.

    Raises:
        ValueError, TypeError: as `Settings.of` and `check_compatibility` do.
    """
    own = {name: value for name, value in arguments.items() if name in Settings.__dataclass_fields__}
    check_compatibility({k: v for k, v in arguments.items() if k not in own and k not in _OF_META})
    return Settings.of(width, height, options, **own)


def rasterization_2dgs(*_: Any, **__: Any) -> Any:
    """Refuse: it is here so that programs that import it beside `rasterization` run as long as they do not call it.

    Raises:
        NotImplementedError: always.
    """
    raise NotImplementedError(
        "rasterization_2dgs is not available: 2D Gaussians (surfels) are not rendered; rasterization takes 3D ones"
    )
