"""Arguments that gsplat's function takes and this one does not need."""

from __future__ import annotations

from typing import Any

_IGNORED = ("packed", "tile_size", "channel_chunk", "segmented")
"""They steer the speed or memory of CUDA kernels, not the image."""

_REFUSED: dict[str, tuple[Any, str]] = {
    "sparse_grad": (False, "gradients are dense"),
    "absgrad": (False, "absolute gradients of the means on the image are not collected"),
    "distributed": (False, "one process renders one image"),
    "camera_model": ("pinhole", "only pinhole cameras are supported"),
    "with_ut": (False, "the projection is linearised, not an unscented transform"),
    "with_eval3d": (False, "splats are evaluated on the image plane"),
    "radial_coeffs": (None, "lens distortion is not supported; undistort the images"),
    "tangential_coeffs": (None, "lens distortion is not supported; undistort the images"),
    "thin_prism_coeffs": (None, "lens distortion is not supported; undistort the images"),
    "ftheta_coeffs": (None, "lens distortion is not supported; undistort the images"),
    "viewmats_rs": (None, "rolling shutters are not supported"),
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
        elif value != _REFUSED[name][0] if not hasattr(value, "shape") else True:
            raise ValueError(f"{name}={value!r} is not available: {_REFUSED[name][1]}")
