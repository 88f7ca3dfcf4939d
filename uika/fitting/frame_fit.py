"""Fit expression, jaw, eyes and pose of a known person to one video frame after the other, in a few milliseconds.

The identity and the focal length are fixed, so each frame is a small bounded least-squares problem with a closed-form
Jacobian, started at the frame before. numpy is used throughout: at this size it is several times faster than torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from uika.fitting.landmarks import CONTOUR_WEIGHT, EYELIDS, LIPS, UNFITTED, LandmarkFit
from uika.head import HeadModel, vertex_normals
from uika.head.actions import fitted_joints, has_actions
from uika.head.axis_angle import Array, axis_angle, cross, rotation

NOISE = 0.02  # expected landmark error, in the face's pixel unit (outer eye-corner distance)
ROBUST_SCALE = 0.08  # errors beyond this lose influence (Geman-McClure)
EXPRESSION_PRIOR = 2.0
STILLNESS = 2.0  # weight of the squared change of an activation since the frame before
JOINT_PRIOR = (4.0, 4.0, 400.0)  # per squared radian about x, y and z: a jaw hardly rolls
STEPS = 6
WALL_ROUNDS = 8
CONVERGED = 1e-4  # relative decrease of the cost
MAX_DAMPING = 1e6
HIDDEN_TRUST, FACING = 0.1, 0.6  # trust of a landmark seen edge-on, and the cosine from which it has full trust


@dataclass(frozen=True)
class Pose:
    """One frame: expression [E], joint rotations [J,3,3] (the fitted ones), head to camera rotation and translation."""

    expression: Array
    joints: Array
    rotation: Array  # [3,3]
    translation: Array  # [3] metres


@dataclass(frozen=True)
class FrameModel:
    """What the frames of one person share; L landmarks, E expressions, J fitted joints."""

    points: Array  # [1+J,L,3] neutral landmarks: the part at rest, then the parts that each fitted joint carries
    basis: Array  # [1+J,L,3,E]
    share: Array  # [J,L] skinning weight of each fitted joint
    pivots: Array  # [J,3]
    joints: tuple[int, ...]  # which joints they are
    normal: Array  # [L,3]
    weight: Array  # [L]
    free: NDArray[np.bool_]  # [E]
    twin: NDArray[np.int64]  # [E] the same action on the other side of the face, itself where there is none
    bounded: bool
    focal: float  # pixels
    unit: float  # metres between the outer eye corners
    triangle: torch.Tensor  # [L]
    barycentric: torch.Tensor  # [L,3]
    ids: NDArray[np.int64]  # [L] rows of the 478-point face mesh; empty for other surface points


def frame_model(head: HeadModel, identity: torch.Tensor, focal: float, unit: float) -> FrameModel:
    """Prepare a person's head for frame-wise fitting to landmarks.

    Args:
        head: the head model.
        identity: [K] fixed coefficients.
        focal: fixed focal length in pixels.
        unit: metres between the outer eye corners, the scale in which errors are weighed.
    """
    ids = head.landmark_ids
    trust = head.landmark_weights.double()
    trust[torch.isin(ids, torch.tensor(EYELIDS + LIPS))] *= CONTOUR_WEIGHT
    model = surface_model(head, identity, focal, unit, head.landmark_faces, head.landmark_barycentrics)
    return replace(model, weight=(trust / trust.mean()).numpy(), ids=ids.numpy())


def surface_model(
    head: HeadModel,
    identity: torch.Tensor,
    focal: float,
    unit: float,
    triangle: torch.Tensor,
    barycentric: torch.Tensor,
) -> FrameModel:
    """The same for any points on the head's surface: L triangles and barycentrics [L,3]; all weights are one."""
    exact = head.to(torch.float64)
    person = identity.double()
    neutral = exact.template + torch.einsum("k,kvc->vc", person, exact.identity_basis)
    joints = fitted_joints(head)
    weights = [1 - exact.lbs_weights[:, list(joints)].sum(-1), *(exact.lbs_weights[:, j] for j in joints)]
    pivots = exact.joints + torch.einsum("k,kjc->jc", person, exact.joint_identity)
    corners, mix = exact.faces[triangle], barycentric.double()

    def points(values: torch.Tensor) -> torch.Tensor:
        return (values[..., corners, :] * mix[:, :, None]).sum(-2)

    return FrameModel(
        points=np.stack([points(neutral * w[:, None]).numpy() for w in weights]),
        basis=np.stack([points(exact.expression_basis * w[:, None]).permute(1, 2, 0).numpy() for w in weights]),
        share=np.array([(w[corners] * mix).sum(-1).numpy() for w in weights[1:]]).reshape(len(joints), len(mix)),
        pivots=pivots[list(joints)].numpy().reshape(-1, 3),
        joints=joints,
        normal=torch.nn.functional.normalize(points(vertex_normals(neutral, exact.faces)), dim=-1).numpy(),
        weight=np.ones(len(mix)),
        free=np.array([name not in UNFITTED for name in head.expression_names]),
        twin=_twins(head.expression_names),
        bounded=has_actions(head),
        focal=focal,
        unit=unit,
        triangle=triangle,
        barycentric=barycentric,
        ids=np.zeros(0, dtype=np.int64),
    )


def _twins(names: tuple[str, ...]) -> NDArray[np.int64]:
    swap = {"Left": "Right", "Right": "Left"}
    other = [next((name[: -len(a)] + b for a, b in swap.items() if name.endswith(a)), name) for name in names]
    return np.array([names.index(twin) if twin in names else index for index, twin in enumerate(other)])


def start_pose(model: FrameModel, fit: LandmarkFit, index: int) -> Pose:
    """The pose of a photo of `fit`, for a model with the same focal length or another one."""
    translation = fit.translation[index].numpy().copy()
    translation[2] *= model.focal / float(fit.focal[index])
    expression = fit.expression[index].numpy()
    if model.bounded:
        expression = expression.clip(0, 1)
    return Pose(expression, np.tile(np.eye(3), (len(model.joints), 1, 1)), fit.rotation[index].numpy(), translation)


def shifted(model: FrameModel, offset: Array) -> FrameModel:
    """The model with its points moved by `offset` [L,3] metres in head space."""
    points = model.points.copy()
    points[0] += offset
    return replace(model, points=points)


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
    weight = model.weight * (cosine / FACING).clip(HIDDEN_TRUST, 1.0) ** 2
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
    matrix[range(E), range(E)] -= EXPRESSION_PRIOR
    gradient[:E] -= EXPRESSION_PRIOR * pose.expression
    return matrix, gradient


def head_landmarks(model: FrameModel, pose: Pose) -> Array:
    """Landmarks [L,3] of an expression in head space, metres."""
    parts = model.points + model.basis @ pose.expression.astype(model.basis.dtype)
    place = parts[0]
    for part, share, pivot, turn in zip(parts[1:], model.share, model.pivots, pose.joints, strict=True):
        arm = part - share[:, None] * pivot
        place = place + arm @ turn.T + share[:, None] * pivot
    return place


def landmark_jacobian(model: FrameModel, pose: Pose) -> Array:
    """Derivative [L,3,E+3J] of the landmarks in head space by expressions and turns of the fitted joints."""
    basis, columns = model.basis[0], []
    parts = model.points[1:] + model.basis[1:] @ pose.expression
    for j, turn in enumerate(pose.joints):
        basis = basis + np.einsum("ab,lbe->lae", turn, model.basis[1 + j])
        columns.append(-cross((parts[j] - model.share[j][:, None] * model.pivots[j]) @ turn.T))
    return np.concatenate((basis, *columns), -1)


def _project(model: FrameModel, pose: Pose) -> tuple[Array, Array]:
    camera = head_landmarks(model, pose) @ pose.rotation.T + pose.translation
    return model.focal * camera[:, :2] / np.maximum(camera[:, 2:], 1e-6), camera


def _cost(model: FrameModel, pose: Pose, start: Pose, residual: Array, weight: Array, stillness: float) -> float:
    square = np.square(residual).sum(-1)
    robust = ROBUST_SCALE**2 * square / (ROBUST_SCALE**2 + square) / NOISE**2
    change = pose.expression - start.expression
    cost = float(weight @ robust + EXPRESSION_PRIOR * (pose.expression @ pose.expression) + stillness * change @ change)
    for turn in pose.joints:
        cost += float(np.array(JOINT_PRIOR) @ np.square(axis_angle(turn)))
    return cost


def _normal_equations(
    model: FrameModel, pose: Pose, start: Pose, seen: Array, weight: Array, scale: float, stillness: float
) -> tuple[Array, Array]:
    """Gauss-Newton matrix [P,P] and gradient [P]; P = E + 3J + 6 (expression, joints, rotation, translation)."""
    pixels, camera = _project(model, pose)
    residual = (pixels - seen) * scale
    robust = np.square(ROBUST_SCALE**2 / (ROBUST_SCALE**2 + np.square(residual).sum(-1)))
    root = np.sqrt(weight * robust) / NOISE
    z = camera[:, 2]
    f = model.focal * scale / z
    d_camera = np.zeros((len(z), 2, 3))
    d_camera[:, 0, 0] = d_camera[:, 1, 1] = f
    d_camera[:, 0, 2], d_camera[:, 1, 2] = -f * camera[:, 0] / z, -f * camera[:, 1] / z
    d_camera *= root[:, None, None]
    d_head = d_camera @ pose.rotation
    face = d_head @ landmark_jacobian(model, pose)
    jacobian = np.concatenate((face, d_camera @ -cross(camera - pose.translation), d_camera), -1)
    jacobian = jacobian.reshape(2 * len(z), -1)
    matrix = jacobian.T @ jacobian
    gradient = jacobian.T @ (root[:, None] * residual).reshape(-1)
    E = len(pose.expression)
    index = np.arange(E)
    matrix[index, index] += EXPRESSION_PRIOR + stillness
    gradient[:E] += EXPRESSION_PRIOR * pose.expression + stillness * (pose.expression - start.expression)
    for j, turn in enumerate(pose.joints):
        at = np.arange(E + 3 * j, E + 3 * j + 3)
        matrix[at, at] += JOINT_PRIOR
        gradient[at] += np.array(JOINT_PRIOR) * axis_angle(turn)
    return matrix, gradient


def _damped_step(model: FrameModel, pose: Pose, matrix: Array, gradient: Array, damping: float) -> Array:
    return bounded_step(model, pose, matrix + np.diag(damping * np.diagonal(matrix) + 1e-9), gradient)


def bounded_step(model: FrameModel, pose: Pose, matrix: Array, gradient: Array) -> Array:
    """Newton step [P] that keeps activations in [0,1]: those that would leave stop at the wall, the rest is re-solved.

    Args:
        model: tells whether there are walls and which expressions are free.
        pose: where the step starts; its expressions come first in the P variables.
        matrix: [P,P] symmetric, positive definite.
        gradient: [P].
    """
    E = len(pose.expression)
    step = np.zeros(len(gradient))
    free = np.ones(len(gradient), dtype=bool)
    free[:E] = model.free
    for _ in range(WALL_ROUNDS):
        rows = np.flatnonzero(free)
        right = -(gradient + matrix @ np.where(free, 0.0, step))[rows]
        step[rows] = np.linalg.solve(matrix[rows][:, rows], right)
        if not model.bounded:
            break
        moved = pose.expression + step[:E]
        outside = free[:E] & ((moved < 0) | (moved > 1))
        if not outside.any():
            break
        step[:E][outside] = moved[outside].clip(0, 1) - pose.expression[outside]
        free[:E] &= ~outside
    return step


def moved(model: FrameModel, pose: Pose, step: Array) -> Pose:
    """The pose after a step [E+3J+6]: expression, joints, rotation, translation."""
    E, J = len(pose.expression), len(model.joints)
    expression = pose.expression + step[:E]
    return Pose(
        expression.clip(0, 1) if model.bounded else expression,
        np.array([rotation(step[E + 3 * j : E + 3 * j + 3]) @ pose.joints[j] for j in range(J)]).reshape(J, 3, 3),
        rotation(step[E + 3 * J : E + 3 * J + 3]) @ pose.rotation,
        pose.translation + step[E + 3 * J + 3 :],
    )
