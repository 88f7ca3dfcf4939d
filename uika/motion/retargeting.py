"""Carry expressions from one head's basis to another's, by what they do to the regions that both heads share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from uika.head import HeadModel, HeadParameters, pose_vertices
from uika.head.actions import fitted_joints
from uika.head.axis_angle import Array, axis_angle, rotation
from uika.head.landmark_model import FrameModel, Pose, bounded_step, frame_model, head_landmarks, landmark_jacobian
from uika.head.rotations import rodrigues
from uika.motion.motion import Motion, MotionError

LANDMARK_NOISE_METRES = 5e-4  # between meshes; against the prior of 1 on each squared coefficient
MIN_SHARED = 50  # landmarks
JOINT_PRIOR = (1.0, 1.0, 100.0)  # per squared radian about x, y and z
STEPS = 4


def transfer(motion: Motion, source: HeadModel, target: HeadModel) -> Motion:
    """The same face movement in another head's expressions, jaw and eyes.

    Both heads carry the same face mesh landmarks, which cover brows, lids, irises, nose, cheeks, lips and chin. For
    each frame, the target's coefficients are the regularised least-squares fit to the source's landmark displacements,
    scaled by the heads' sizes.

    Args:
        motion: a motion of `source`.
        source: the head it was made for.
        target: the head that it shall move.

    Raises:
        MotionError: the heads share too few landmarks, or the motion does not fit the source.
    """
    if motion.expression.shape[1] != len(source.expression_names):
        raise MotionError(f"the motion has {motion.expression.shape[1]} expressions; '{source.id}' has others")
    shared = sorted(set(source.landmark_ids.tolist()) & set(target.landmark_ids.tolist()))
    if len(shared) < MIN_SHARED:
        raise MotionError(f"the head models '{source.id}' and '{target.id}' share only {len(shared)} landmarks")
    rows = [_rows(head, shared) for head in (source, target)]
    model = _kept(frame_model(target, torch.zeros(len(target.identity_basis)), 1.0, 1.0), rows[1])
    rest = source.landmarks(source.template)[rows[0]]
    size = _spread(target.landmarks(target.template)[rows[1]]) / _spread(rest)
    moved = source.landmarks(pose_vertices(source, _face_only(motion, source)))[:, rows[0]]
    wanted = model.points.sum(0) + (size * (moved - rest)).double().numpy()
    J = len(model.joints)
    pose = Pose(np.zeros(len(target.expression_names)), np.tile(np.eye(3), (J, 1, 1)), np.eye(3), np.zeros(3))
    expressions, turns = [], []
    for frame in wanted:
        pose = _solve(model, frame, pose)
        expressions.append(pose.expression)
        turns.append([axis_angle(turn) for turn in pose.joints])
    changed = {"jaw": torch.zeros(len(motion), 3), "eyes": torch.zeros(len(motion), 6)}
    turned = torch.tensor(np.array(turns).reshape(len(motion), J, 3), dtype=torch.float32)
    for k, joint in enumerate(model.joints):
        if joint == 2:
            changed["jaw"] = turned[:, k]
        else:
            changed["eyes"][:, 3 * (joint - 3) : 3 * (joint - 2)] = turned[:, k]
    expression = torch.tensor(np.array(expressions), dtype=torch.float32)
    return replace(motion, expression=expression, jaw=changed["jaw"], eyes=changed["eyes"])


def turned_by_the_neck(motion: Motion, head: HeadModel) -> Motion:
    """The same movement of the head with a root that does not turn, so that a bust stands still below it."""
    first = rodrigues(motion.rotation)
    both = (first @ rodrigues(motion.neck)).double().numpy()
    arm = head.joints[1] - head.joints[0]
    neck = torch.tensor(np.stack([axis_angle(turn) for turn in both]), dtype=torch.float32)
    return replace(
        motion,
        rotation=torch.zeros_like(neck),
        neck=neck,
        translation=motion.translation + (first @ arm - arm),
    )


def _rows(head: HeadModel, shared: list[int]) -> Tensor:
    place = {mark: row for row, mark in enumerate(head.landmark_ids.tolist())}
    return torch.tensor([place[mark] for mark in shared])


def _spread(points: Tensor) -> float:
    return float((points - points.mean(0)).square().sum(-1).mean().sqrt())


def _face_only(motion: Motion, head: HeadModel) -> HeadParameters:
    """The motion with the head held still."""
    still = torch.zeros(len(motion), 3)
    params = motion.parameters(torch.zeros(len(head.identity_basis)))
    eyes = motion.eyes if set(fitted_joints(head)) & {3, 4} else torch.zeros_like(motion.eyes)
    return params.replace(rotation=still, neck=still, translation=still, eyes=eyes)


def _kept(model: FrameModel, rows: Tensor) -> FrameModel:
    index = rows.numpy()
    return replace(
        model,
        points=model.points[:, index],
        basis=model.basis[:, index],
        share=model.share[:, index],
        normal=model.normal[index],
        weight=model.weight[index],
        ids=model.ids[index],
    )


def _solve(model: FrameModel, wanted: Array, start: Pose) -> Pose:
    """Gauss-Newton on the landmarks [L,3] in head space; nearly linear, so it needs no damping."""
    pose, E = start, len(start.expression)
    for _ in range(STEPS):
        residual = head_landmarks(model, pose) - wanted
        jacobian = landmark_jacobian(model, pose)
        root = np.sqrt(model.weight)[:, None] / LANDMARK_NOISE_METRES
        rows = (jacobian * root[..., None]).reshape(-1, jacobian.shape[-1])
        joint_values = np.concatenate([axis_angle(turn) for turn in pose.joints]) if len(pose.joints) else np.zeros(0)
        prior = np.concatenate((np.ones(E), np.tile(JOINT_PRIOR, len(pose.joints))))
        matrix = rows.T @ rows + np.diag(prior)
        gradient = rows.T @ (residual * root).reshape(-1) + prior * np.concatenate((pose.expression, joint_values))
        step = bounded_step(model, pose, matrix, gradient)
        turns = [rotation(step[E + 3 * j : E + 3 * j + 3]) @ turn for j, turn in enumerate(pose.joints)]
        pose = replace(
            pose, expression=pose.expression + step[:E], joints=np.array(turns).reshape(len(pose.joints), 3, 3)
        )
    return pose
