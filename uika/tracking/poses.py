"""From fitted poses to a motion in head space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from uika.head import HeadModel
from uika.head.axis_angle import Array, axis_angle, rotation
from uika.head.landmark_model import FrameModel, Pose
from uika.motion import Motion


def without_gaps(poses: dict[int, Pose], count: int) -> list[Pose]:
    """A pose for each frame: gaps are bridged evenly, the ends held."""
    known = sorted(poses)
    complete = []
    for index in range(count):
        after = int(np.searchsorted(known, index))
        if index in poses or after == 0 or after == len(known):
            complete.append(poses[known[min(after, len(known) - 1)]])
            continue
        a, b = known[after - 1], known[after]
        complete.append(_between(poses[a], poses[b], (index - a) / (b - a)))
    return complete


def poses_between(poses: Sequence[Pose], places: Array) -> list[Pose]:
    """The poses at `places` [S] between those of T frames."""
    found = []
    for place in places:
        before = int(place)
        after = min(before + 1, len(poses) - 1)
        found.append(_between(poses[before], poses[after], float(place - before)))
    return found


def _between(one: Pose, other: Pose, share: float) -> Pose:
    def turned(a: Array, b: Array) -> Array:
        return rotation(share * axis_angle(b @ a.T)) @ a

    return Pose(
        (1 - share) * one.expression + share * other.expression,
        np.array([turned(a, b) for a, b in zip(one.joints, other.joints, strict=True)]).reshape(one.joints.shape),
        turned(one.rotation, other.rotation),
        (1 - share) * one.translation + share * other.translation,
    )


def poses_to_motion(poses: Sequence[Pose], model: FrameModel, head: HeadModel, identity: Tensor, fps: float) -> Motion:
    """The poses as a motion in head space, as if a camera stood straight before the head's middle place.

    The neck turns the head, so that the torso stands still.
    """
    flip = np.diag([1.0, -1.0, -1.0])  # camera axes to head axes
    neck = (head.joints[1].double() + torch.einsum("k,kc->c", identity, head.joint_identity[:, 1].double())).numpy()
    turns = np.stack([flip @ pose.rotation for pose in poses])
    places = np.stack([flip @ pose.translation for pose in poses]) + turns @ neck - neck
    rotations = _unwrapped(np.stack([axis_angle(turn) for turn in turns]))
    T = len(poses)
    jaw, eyes = np.zeros((T, 3)), np.zeros((T, 6))
    for k, joint in enumerate(model.joints):
        values = np.stack([axis_angle(pose.joints[k]) for pose in poses])
        if joint == 2:
            jaw = values
        else:
            eyes[:, 3 * (joint - 3) : 3 * (joint - 2)] = values

    def real(array: Array) -> Tensor:
        return torch.tensor(array, dtype=torch.float32)

    return Motion(
        expression=real(np.stack([pose.expression for pose in poses])),
        rotation=torch.zeros(T, 3),
        neck=real(rotations),
        jaw=real(jaw),
        eyes=real(eyes),
        translation=real(places - np.median(places, 0)),
        fps=fps,
    )


def _unwrapped(rotations: Array) -> Array:
    """Axis-angle vectors [T,3] without jumps from one side of half a turn to the other."""
    result = rotations.copy()
    for index in range(1, len(result)):
        angle = float(np.linalg.norm(result[index]))
        if angle > 1e-6:
            other = result[index] * (1 - 2 * np.pi / angle)
            if np.linalg.norm(other - result[index - 1]) < np.linalg.norm(result[index] - result[index - 1]):
                result[index] = other
    return result
