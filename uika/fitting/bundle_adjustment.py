"""Sharpen a person's identity and the focal length with the colours of several frames.

Landmarks of a detector err the same way in every frame, so more frames do not average their errors out. Colours do not:
a surface point must show the same grey level in all frames, whatever that level is. Unknown levels are eliminated in
closed form (variable projection), so that identity, focal length and all poses move together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uika.fitting.jacobians import level_jacobian
from uika.fitting.landmark_prior import identity_modes, landmark_anchor
from uika.fitting.photometric import (
    CORRELATED,
    LIGHT_PRIOR,
    Appearance,
    FaceCrop,
    along_surface,
    place_points,
    point_trust,
    sample,
)
from uika.fitting.weights import GREY_EXPRESSION_PRIOR, GREY_NOISE, GREY_ROBUST_SCALE
from uika.head import HeadModel
from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose, moved, shifted

MODES = 60  # of the identity; finer ones do not show at video resolution
IDENTITY_PULL = 3.0  # per squared standard deviation away from the landmarks' identity
FOCAL_SPREAD = 0.2  # of the logarithm of the focal length
STEPS = 6
MIN_VIEWS = 2  # a point seen less often tells nothing
_DAMPING = 1e-2


@dataclass(frozen=True)
class Bundle:
    """Identity offset [MODES] from the start, focal length in pixels, poses by frame, and cost before and after."""

    offset: Array
    focal: float
    poses: dict[int, Pose]
    costs: tuple[float, float]


def bundle(
    head: HeadModel,
    person: Appearance,
    model: FrameModel,
    poses: Mapping[int, Pose],
    views: Mapping[int, FaceCrop],
    targets: Mapping[int, Array],
    pull: float,
    focal_spread: float = FOCAL_SPREAD,
) -> Bundle:
    """Refine what the frames of one person share, together with their poses.

    Args:
        head: the head model.
        person: its surface points; the levels in it are not used.
        model: the same person's landmarks.
        poses: start of each frame.
        views: each frame's picture.
        targets: each frame's landmarks [478,2], pixels relative to the principal point.
        pull: weight of the landmarks, on poses and identity.
        focal_spread: expected error of the logarithm of the focal length; tiny to keep it.
    """
    frames = sorted(poses)
    P = len(model.free) + 3 * len(model.joints) + 6
    state = Bundle(np.zeros(MODES), model.focal, dict(poses), (0.0, 0.0))
    modes, marks = identity_modes(head, person.model, MODES), identity_modes(head, model, MODES)
    anchors = {k: tuple(pull * part for part in landmark_anchor(model, marks, poses[k], targets[k])) for k in frames}
    travelled = {k: np.zeros(MODES + 1 + P) for k in frames}
    rows = _rows(person.model, modes, state, views, frames)
    cost = first = _cost(rows, state, travelled, anchors, model.focal, focal_spread)
    damping = _DAMPING
    for _ in range(STEPS):
        shared, steps = _step(rows, state, travelled, anchors, model, damping, focal_spread)
        trial = Bundle(
            state.offset + shared[:-1],
            state.focal * math.exp(float(np.clip(shared[-1], -0.3, 0.3))),
            {k: moved(model, state.poses[k], steps[k]) for k in frames},
            state.costs,
        )
        far = {k: travelled[k] + np.concatenate((shared, steps[k])) for k in frames}
        trial_rows = _rows(person.model, modes, trial, views, frames)
        trial_cost = _cost(trial_rows, trial, far, anchors, model.focal, focal_spread)
        if trial_cost < cost:
            state, rows, travelled, cost, damping = trial, trial_rows, far, trial_cost, damping / 5
        else:
            damping *= 10
    return replace(state, costs=(first, cost))


@dataclass(frozen=True)
class _Rows:
    weight: Array  # [N,M]
    robust: Array  # [N,M]
    shared: list[NDArray[np.float32]]  # N x [M,MODES+1]
    own: list[NDArray[np.float32]]  # N x [M,P]
    residual: Array  # [N,M] grey levels, light taken out, against the best common level


def _rows(
    model: FrameModel, modes: NDArray[np.float32], state: Bundle, views: Mapping[int, FaceCrop], frames: Sequence[int]
) -> _Rows:
    offset = np.asarray(modes @ state.offset, dtype=np.float64).T
    current = replace(shifted(model, offset), focal=state.focal)
    levels, weights, shared, own, facing = [], [], [], [], []
    for k in frames:
        pose, view = state.poses[k], views[k]
        place, camera = place_points(current, pose, view)
        values = sample(view, place)
        slope = values[:, 1:] * (view.scale * state.focal) / camera[:, 2:]
        d_camera = level_jacobian(slope, camera)
        d_head = (d_camera @ pose.rotation).astype(np.float32)
        mine = np.empty((len(camera), len(model.free) + 3 * len(model.joints) + 6), dtype=np.float32)
        along_surface(current, pose, d_head, mine[:, :-6])
        mine[:, -6:-3] = np.cross(camera - pose.translation, d_camera)
        mine[:, -3:] = d_camera
        common = np.empty((len(camera), MODES + 1), dtype=np.float32)
        common[:, :-1] = (d_head.T[:, :, None] * modes).sum(0)
        common[:, -1] = (slope * camera[:, :2]).sum(-1)
        levels.append(values[:, 0])
        weights.append(point_trust(current, pose, camera) / (CORRELATED * GREY_NOISE**2))
        shared.append(common)
        own.append(mine)
        facing.append(np.concatenate((np.ones((len(camera), 1)), model.normal @ pose.rotation.T), -1))
    level, weight = np.stack(levels), np.stack(weights)
    weight *= (weight > 0).sum(0) >= MIN_VIEWS
    gain, middle = np.ones_like(level), _common(level, weight)
    for _ in range(3):
        robust = GREY_ROBUST_SCALE**2 / (GREY_ROBUST_SCALE**2 + (level / gain - middle) ** 2)
        gain = _light(level, middle[0], weight * robust**2, np.stack(facing))
        middle = _common(level / gain, weight * robust**2)
    inverse = (1 / gain).astype(np.float32)[..., None]
    shared = [rows * factor for rows, factor in zip(shared, inverse, strict=True)]
    own = [rows * factor for rows, factor in zip(own, inverse, strict=True)]
    return _Rows(weight, robust, shared, own, level / gain - middle)


def _light(level: Array, middle: Array, weight: Array, facing: Array) -> Array:
    """Gain [N,M] of each frame over the common level: smooth in the surface's direction [N,M,4]."""
    lit = facing * middle[:, None]
    matrix = (lit * weight[..., None]).transpose(0, 2, 1) @ lit + np.diag(LIGHT_PRIOR)
    right = ((lit * (weight * level)[..., None]).sum(1) + np.array(LIGHT_PRIOR) * (1.0, 0.0, 0.0, 0.0))[..., None]
    return np.asarray((facing @ np.linalg.solve(matrix, right))[..., 0].clip(0.2, 5.0))


def _common(level: Array, weight: Array) -> Array:
    return np.asarray((level * weight).sum(0, keepdims=True) / np.maximum(weight.sum(0, keepdims=True), 1e-12))


def _cost(
    rows: _Rows,
    state: Bundle,
    travelled: Mapping[int, Array],
    anchors: Mapping[int, tuple[Array, ...]],
    start: float,
    focal_spread: float,
) -> float:
    square = rows.residual**2
    cost = float((rows.weight * square * GREY_ROBUST_SCALE**2 / (GREY_ROBUST_SCALE**2 + square)).sum())
    cost += IDENTITY_PULL * float(state.offset @ state.offset) + (math.log(state.focal / start) / focal_spread) ** 2
    for k, pose in state.poses.items():
        far, (matrix, gradient) = travelled[k], anchors[k]
        cost += GREY_EXPRESSION_PRIOR * float(pose.expression @ pose.expression)
        cost += float(2 * gradient @ far + far @ matrix @ far)
    return cost


def _step(
    rows: _Rows,
    state: Bundle,
    travelled: Mapping[int, Array],
    anchors: Mapping[int, tuple[Array, ...]],
    model: FrameModel,
    damping: float,
    focal_spread: float,
) -> tuple[Array, dict[int, Array]]:
    """One Gauss-Newton step of the shared [MODES+1] and of each frame's variables [P]."""
    frames = sorted(state.poses)
    K, P, E = MODES + 1, rows.own[0].shape[1], len(model.free)
    size = K + P * len(frames)
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    weight = (rows.weight * rows.robust**2).astype(np.float32)
    coupling = np.zeros((weight.shape[1], size), dtype=np.float32)
    for n, k in enumerate(frames):
        at = slice(K + P * n, K + P * (n + 1))
        pair = np.concatenate((rows.shared[n], rows.own[n]), 1)
        weighted = pair * weight[n][:, None]
        block = weighted.T @ pair
        slope = weighted.T @ rows.residual[n].astype(np.float32)
        matrix[:K, :K] += block[:K, :K]
        matrix[:K, at], matrix[at, :K] = block[:K, K:], block[K:, :K]
        matrix[at, at] += block[K:, K:]
        gradient[:K] += slope[:K]
        gradient[at] += slope[K:]
        coupling[:, :K] += weighted[:, :K]
        coupling[:, at] = weighted[:, K:]
        diagonal = np.arange(at.start, at.start + E)
        matrix[diagonal, diagonal] += GREY_EXPRESSION_PRIOR
        gradient[diagonal] += GREY_EXPRESSION_PRIOR * state.poses[k].expression
        every = np.r_[:K, at.start : at.stop]
        matrix[np.ix_(every, every)] += anchors[k][0]
        gradient[every] += anchors[k][1] + anchors[k][0] @ travelled[k]
    coupling /= np.sqrt(np.maximum(weight.sum(0), 1e-9))[:, None]
    matrix -= coupling.T @ coupling
    identity = np.arange(K - 1)
    matrix[identity, identity] += IDENTITY_PULL
    gradient[: K - 1] += IDENTITY_PULL * state.offset
    matrix[K - 1, K - 1] += focal_spread**-2
    gradient[K - 1] += math.log(state.focal / model.focal) / focal_spread**2
    index = np.arange(size)
    matrix[index, index] += damping * np.abs(np.diagonal(matrix)) + 1e-6
    free = np.ones(size, dtype=bool)
    for n, k in enumerate(frames):
        at = slice(K + P * n, K + P * n + E)
        free[at] = model.free
        if model.bounded:
            now, push = state.poses[k].expression, gradient[at]
            free[at] &= ~(((now <= 0) & (push > 0)) | ((now >= 1) & (push < 0)))
    step = np.zeros(size)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], -gradient[free])
    return step[:K], {k: step[K + P * n : K + P * (n + 1)] for n, k in enumerate(frames)}
