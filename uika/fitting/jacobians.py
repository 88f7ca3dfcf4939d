"""Derivatives of what a camera sees by points in its space, shared by all fits; numpy."""

from __future__ import annotations

import numpy as np

from uika.head.axis_angle import Array


def projection_jacobian(camera: Array, focal: Array) -> Array:
    """Derivative of projected points by their place in camera space.

    Args:
        camera: [...,3] points in camera space, metres, z forward.
        focal: [...] focal length in the units of the projection.

    Returns:
        [...,2,3].
    """
    z = camera[..., 2]
    scale = focal / z
    result = np.zeros((*camera.shape[:-1], 2, 3))
    result[..., 0, 0] = result[..., 1, 1] = scale
    result[..., 0, 2], result[..., 1, 2] = -scale * (camera[..., 0] / z), -scale * (camera[..., 1] / z)
    return result


def level_jacobian(slope: Array, camera: Array) -> Array:
    """Derivative [M,3] of the grey level at projected points by their place in camera space.

    Args:
        slope: [M,2] slopes of the picture's level along x and y, times focal length over depth.
        camera: [M,3] points in camera space, metres.
    """
    along_ray = -(slope * camera[:, :2]).sum(-1, keepdims=True) / camera[:, 2:]
    return np.concatenate((slope, along_ray), -1)
