"""Lids, gaze and brows in full range: what landmarks say of them within the face, once the clip has told their bias.

Colours and robust landmarks damp these small movements. Their sizes relative to the corners of the eyes do not depend
on the head's pose, and the detector's and identity's errors in them are the same in all frames of a clip: they are
taken out as the median difference between picture and model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose, head_landmarks

# Face mesh points of the right and the left eye: outer and inner corner, pairs of upper and lower lid, iris, brow.
_CORNERS = ((33, 133), (263, 362))
_LIDS = (((160, 144), (159, 145), (158, 153)), ((387, 373), (386, 374), (385, 380)))
_IRIS = (468, 473)
_BROW = ((70, 105, 55), (300, 334, 285))
_POINTS = sorted({*np.ravel(_CORNERS), *np.ravel(_LIDS), *_IRIS, *np.ravel(_BROW)})
_ACTIONS = ("eyeBlink", "eyeWide", "eyeLook", "browDown", "browInnerUp", "browOuterUp")
_NOISE = np.array([0.02] * 2 + [0.02] * 4 + [0.03] * 6)  # of the measures, in widths of an eye
_PULL = 1.0  # per squared activation away from the fit
_STEPS = 3
_SLOPE = 1e-3  # activation, for derivatives
_MIN_FRAMES = 10  # fewer tell no bias
_HIDDEN = 0.55  # cosine of the head's turn below which the far eye is not measured


def full_range(
    model: FrameModel, names: tuple[str, ...], poses: dict[int, Pose], targets: dict[int, Array]
) -> dict[int, Pose]:
    """The poses with lids, gaze and brows as far as the landmarks move.

    Args:
        model: the person's landmarks, with irises.
        names: of the E expressions.
        poses: as fitted, by frame.
        targets: landmarks [478,2] in pixels relative to the principal point, by frame.

    Returns:
        The poses; the same ones where the head has no such actions or the clip is too short.
    """
    actions = np.array([index for index, name in enumerate(names) if name.startswith(_ACTIONS)])
    row = {int(point): index for index, point in enumerate(model.ids)}
    if not model.bounded or not set(_POINTS) <= set(row) or len(poses) < _MIN_FRAMES:
        return poses
    seen = {index: _measures(targets[index]) for index in poses}
    made = {index: _of_pose(model, row, pose) for index, pose in poses.items()}
    bias = np.median([seen[index] - made[index] for index in poses], axis=0)
    wanted = {index: _calmed(seen, index) - bias for index in poses}
    return {index: _moved(model, row, actions, pose, wanted[index]) for index, pose in poses.items()}


def _calmed(seen: dict[int, Array], index: int) -> Array:
    """The measures of a frame, those of gaze and brows averaged with its neighbours': lids alone move that fast."""
    before, after = (seen.get(index + step, seen[index]) for step in (-1, 1))
    calm = (before + 2 * seen[index] + after) / 4
    return np.concatenate((seen[index][:2], calm[2:]))


def _moved(model: FrameModel, row: dict[int, int], actions: Array, pose: Pose, wanted: Array) -> Pose:
    """Gauss-Newton over the actions alone, between their walls."""
    from scipy.optimize import lsq_linear

    if -pose.rotation[2, 2] < _HIDDEN:
        return pose
    start, now = pose.expression[actions], pose
    pull = np.sqrt(_PULL) * np.eye(len(actions))
    for _ in range(_STEPS):
        here, value = _of_pose(model, row, now), now.expression[actions]
        slopes = []
        for action in actions:
            step = _SLOPE if now.expression[action] < 0.5 else -_SLOPE
            expression = now.expression.copy()
            expression[action] += step
            slopes.append((_of_pose(model, row, replace(now, expression=expression)) - here) / step)
        jacobian = np.stack(slopes, 1) / _NOISE[:, None]
        right = (wanted - here) / _NOISE + jacobian @ value
        solved = lsq_linear(np.concatenate((jacobian, pull)), np.concatenate((right, pull @ start)), (0.0, 1.0))
        expression = now.expression.copy()
        expression[actions] = solved.x
        now = replace(now, expression=expression)
    return now


def _of_pose(model: FrameModel, row: dict[int, int], pose: Pose) -> Array:
    chosen = [row[point] for point in _POINTS]
    part = replace(model, points=model.points[:, chosen], basis=model.basis[:, chosen], share=model.share[:, chosen])
    camera = head_landmarks(part, pose) @ pose.rotation.T + pose.translation
    marks = np.zeros((478, 2))
    marks[_POINTS] = model.focal * camera[:, :2] / np.maximum(camera[:, 2:], 1e-6)
    return _measures(marks)


def _measures(marks: Array) -> Array:
    """Lid gaps [2], gaze [4] and brow heights [6] of landmarks [478,2], in widths of the eye that they belong to."""
    gaps, gaze, brows = [], [], []
    # Both eyes share one axis and one width: an eye's own are as uncertain as its corners.
    axis = marks[_CORNERS[1][0]] - marks[_CORNERS[0][0]]
    axis = axis / max(float(np.linalg.norm(axis)), 1e-6)
    down = np.array([-axis[1], axis[0]])
    for corners, lids, iris, brow in zip(_CORNERS, _LIDS, _IRIS, _BROW, strict=True):
        ends = marks[list(corners)]
        width = max(abs(float((ends[1] - ends[0]) @ axis)), 1e-6)
        middle = ends.mean(0)
        gaps.append(np.mean([(marks[low] - marks[high]) @ down for high, low in lids]) / width)
        gaze += [float((marks[iris] - middle) @ direction) / width for direction in (axis, down)]
        brows += [float((middle - marks[point]) @ down) / width for point in brow]
    return np.array([*gaps, *gaze, *brows])
