"""Rotations as axis-angle vectors and matrices, in numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation(axis_angle: Array) -> Array:
    """Rotation [3,3] about an axis-angle vector [3]."""
    angle = float(np.linalg.norm(axis_angle))
    if angle < 1e-12:
        return np.eye(3)
    skew = cross(axis_angle / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew)


def axis_angle(matrix: Array) -> Array:
    """Axis-angle vector [3] of a rotation [3,3] of less than half a turn."""
    twist = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    sine = float(np.linalg.norm(twist))
    angle = np.arctan2(sine, (np.trace(matrix) - 1) / 2)
    return np.asarray(twist * (angle / sine) if sine > 1e-12 else twist)


def cross(vectors: Array) -> Array:
    """Matrices [...,3,3] that take the cross product with vectors [...,3]."""
    result = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = z, -y, x
    return result
