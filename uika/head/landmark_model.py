"""The landmarks of a person's head as functions of expression, joints and pose, with closed-form derivatives; numpy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from uika.head import HeadModel, vertex_normals
from uika.head.actions import fitted_joints, has_actions
from uika.head.axis_angle import Array, cross, rotation

WALL_ROUNDS = 8


# Contours of eyelids and lips: small errors there are the ones people see.
EYELIDS = (
    33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246,
    263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466,
)  # fmt: skip
LIPS = (
    61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185,
    78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191,
)  # fmt: skip
CONTOUR_WEIGHT = 3.0
UNFITTED = ("tongueOut",)  # no landmark sees the tongue


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


def shifted(model: FrameModel, offset: Array) -> FrameModel:
    """The model with its points moved by `offset` [L,3] metres in head space."""
    points = model.points.copy()
    points[0] += offset
    return replace(model, points=points)


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
