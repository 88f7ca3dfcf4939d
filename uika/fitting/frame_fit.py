"""Fit expression, jaw, eyes and pose of a known person to one video frame after the other, in a few milliseconds.

The identity and the focal length are fixed, so each frame is a small bounded least-squares problem with a closed-form
Jacobian, started at the frame before. numpy is used throughout: at this size it is several times faster than torch.
"""

from __future__ import annotations

import numpy as np

from uika.fitting.jacobians import projection_jacobian
from uika.fitting.landmarks import LandmarkFit
from uika.fitting.weights import (
    FRAME_ROBUST_SCALE,
    LANDMARK_EXPRESSION_PRIOR,
    LANDMARK_FACING,
    LANDMARK_HIDDEN_TRUST,
    LANDMARK_NOISE,
)
from uika.head.axis_angle import Array, axis_angle, cross
from uika.head.landmark_model import (
    FrameModel,
    Pose,
    bounded_step,
    head_landmarks,
    landmark_jacobian,
    moved,
)

STILLNESS = 2.0  # weight of the squared change of an activation since the frame before
JOINT_PRIOR = (4.0, 4.0, 400.0)  # per squared radian about x, y and z: a jaw hardly rolls
STEPS = 6
CONVERGED = 1e-4  # relative decrease of the cost
MAX_DAMPING = 1e6


def start_pose(model: FrameModel, fit: LandmarkFit, index: int) -> Pose:
    """The pose of a photo of `fit`, for a model with the same focal length or another one."""
    translation = fit.translation[index].numpy().copy()
    translation[2] *= model.focal / float(fit.focal[index])
    expression = fit.expression[index].numpy()
    if model.bounded:
        expression = expression.clip(0, 1)
    return Pose(expression, np.tile(np.eye(3), (len(model.joints), 1, 1)), fit.rotation[index].numpy(), translation)


def fit_frame(model: FrameModel, target: Array, start: Pose, stillness: float = STILLNESS) -> tuple[Pose, float]:
    """Fit one frame.

    Args:
        model: the person.
        target: [478,2] landmarks in pixels relative to the principal point.
        start: the pose of the frame before, or a guess.
        stillness: weight of changes of expression since `start`.

    Returns:
        The pose and its mean landmark error in eye-corner distances.
    """
    seen = target[model.ids]
    pose, damping = start, 1e-4
    pixels, camera = _project(model, pose)
    cosine = -((model.normal @ pose.rotation.T) * camera).sum(-1) / np.linalg.norm(camera, axis=-1)
    weight = model.weight * (cosine / LANDMARK_FACING).clip(LANDMARK_HIDDEN_TRUST, 1.0) ** 2
    weight /= weight.mean()
    scale = camera[:, 2].mean() / (model.focal * model.unit)  # eye-corner distances per pixel
    cost = _cost(model, pose, start, (pixels - seen) * scale, weight, stillness)
    for _ in range(STEPS):
        system = _normal_equations(model, pose, start, seen, weight, scale, stillness)
        before = cost
        while damping < MAX_DAMPING:
            trial = moved(model, pose, _damped_step(model, pose, *system, damping))
            pixels, camera = _project(model, trial)
            trial_cost = _cost(model, trial, start, (pixels - seen) * scale, weight, stillness)
            if trial_cost <= cost and camera[:, 2].min() > 1e-3:
                break
            damping *= 10.0
        else:
            break
        pose, cost, damping = trial, trial_cost, max(damping / 5.0, 1e-6)
        if before - cost < CONVERGED * cost:
            break
    residual = _project(model, pose)[0] - seen
    return pose, float(np.linalg.norm(residual, axis=-1).mean() * scale)


def landmark_pull(model: FrameModel, pose: Pose, target: Array) -> tuple[Array, Array]:
    """Gauss-Newton matrix [P,P] and gradient [P] of the landmark term alone, without priors, at `pose`."""
    seen = target[model.ids]
    scale = float(pose.translation[2]) / (model.focal * model.unit)
    matrix, gradient = _normal_equations(model, pose, pose, seen, model.weight, scale, 0.0)
    E = len(pose.expression)
    matrix[range(E), range(E)] -= LANDMARK_EXPRESSION_PRIOR
    gradient[:E] -= LANDMARK_EXPRESSION_PRIOR * pose.expression
    return matrix, gradient


def _project(model: FrameModel, pose: Pose) -> tuple[Array, Array]:
    camera = head_landmarks(model, pose) @ pose.rotation.T + pose.translation
    return model.focal * camera[:, :2] / np.maximum(camera[:, 2:], 1e-6), camera


def _cost(model: FrameModel, pose: Pose, start: Pose, residual: Array, weight: Array, stillness: float) -> float:
    square = np.square(residual).sum(-1)
    robust = FRAME_ROBUST_SCALE**2 * square / (FRAME_ROBUST_SCALE**2 + square) / LANDMARK_NOISE**2
    change = pose.expression - start.expression
    cost = float(
        weight @ robust + LANDMARK_EXPRESSION_PRIOR * (pose.expression @ pose.expression) + stillness * change @ change
    )
    for turn in pose.joints:
        cost += float(np.array(JOINT_PRIOR) @ np.square(axis_angle(turn)))
    return cost


def _normal_equations(
    model: FrameModel, pose: Pose, start: Pose, seen: Array, weight: Array, scale: float, stillness: float
) -> tuple[Array, Array]:
    """Gauss-Newton matrix [P,P] and gradient [P]; P = E + 3J + 6 (expression, joints, rotation, translation)."""
    pixels, camera = _project(model, pose)
    residual = (pixels - seen) * scale
    robust = np.square(FRAME_ROBUST_SCALE**2 / (FRAME_ROBUST_SCALE**2 + np.square(residual).sum(-1)))
    root = np.sqrt(weight * robust) / LANDMARK_NOISE
    z = camera[:, 2]
    d_camera = projection_jacobian(camera, np.full(len(z), model.focal * scale)) * root[:, None, None]
    d_head = d_camera @ pose.rotation
    face = d_head @ landmark_jacobian(model, pose)
    jacobian = np.concatenate((face, d_camera @ -cross(camera - pose.translation), d_camera), -1)
    jacobian = jacobian.reshape(2 * len(z), -1)
    matrix = jacobian.T @ jacobian
    gradient = jacobian.T @ (root[:, None] * residual).reshape(-1)
    E = len(pose.expression)
    index = np.arange(E)
    matrix[index, index] += LANDMARK_EXPRESSION_PRIOR + stillness
    gradient[:E] += LANDMARK_EXPRESSION_PRIOR * pose.expression + stillness * (pose.expression - start.expression)
    for j, turn in enumerate(pose.joints):
        at = np.arange(E + 3 * j, E + 3 * j + 3)
        matrix[at, at] += JOINT_PRIOR
        gradient[at] += np.array(JOINT_PRIOR) * axis_angle(turn)
    return matrix, gradient


def _damped_step(model: FrameModel, pose: Pose, matrix: Array, gradient: Array, damping: float) -> Array:
    return bounded_step(model, pose, matrix + np.diag(damping * np.diagonal(matrix) + 1e-9), gradient)
