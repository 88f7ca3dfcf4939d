"""What landmarks know of a person's photos, as a quadratic that holds a refinement by colours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uika.fitting.jacobians import projection_jacobian
from uika.fitting.weights import FRAME_ROBUST_SCALE, LANDMARK_FACING, LANDMARK_HIDDEN_TRUST, LANDMARK_NOISE
from uika.head import HeadModel
from uika.head.axis_angle import Array, cross
from uika.head.landmark_model import FrameModel, Pose, head_landmarks, landmark_jacobian

NEIGHBOURS = 4
GROUP = 100.0  # landmarks that err as one when neighbours err alike


def identity_modes(head: HeadModel, model: FrameModel, count: int) -> NDArray[np.float32]:
    """The first `count` identity modes [3,M,count] at the model's points, metres per standard deviation."""
    corners, mix = head.faces[model.triangle], model.barycentric
    basis = head.identity_basis[:count]
    return (basis[:, corners] * mix[None, :, :, None]).sum(2).permute(2, 1, 0).contiguous().numpy()


def landmark_anchor(model: FrameModel, modes: NDArray[np.float32], pose: Pose, target: Array) -> tuple[Array, Array]:
    """Gauss-Newton matrix [S,S] and gradient [S] of a photo's landmark term, without priors.

    Args:
        model: the person's landmarks.
        modes: [3,L,K] identity modes at them.
        pose: where the term is expanded.
        target: [478,2] landmarks in pixels relative to the principal point.

    Returns:
        Over S = K + 1 + E + 3J + 6 variables: identity, logarithm of the focal length, then the pose as in `moved`.
    """
    residual, root, camera, scale = _residuals(model, pose, target)
    z = camera[:, 2]
    d_camera = projection_jacobian(camera, np.full(len(z), model.focal * scale))
    d_head = d_camera @ pose.rotation
    parts = (
        np.einsum("lij,jlk->lik", d_head, modes),
        (model.focal * scale / z[:, None] * camera[:, :2])[..., None],
        d_head @ landmark_jacobian(model, pose),
        d_camera @ -cross(camera - pose.translation),
        d_camera,
    )
    rows = (root[:, None, None] * np.concatenate(parts, -1)).reshape(2 * len(z), -1)
    return rows.T @ rows, rows.T @ (root[:, None] * residual).reshape(-1)


def landmark_trust(model: FrameModel, poses: Mapping[int, Pose], targets: Mapping[int, Array]) -> float:
    """Factor on the landmark term that meets the real noise of fitted photos.

    The residuals' scale tells how large the noise is. How alike neighbours err tells how much of it is systematic:
    detectors err smoothly over the face, and such errors do not average out over the landmarks.
    """
    place = model.points.sum(0)
    near = np.linalg.norm(place[:, None] - place[None], axis=-1).argsort(1)[:, 1 : NEIGHBOURS + 1]
    square = product = total = 0.0
    for k, pose in poses.items():
        residual, root, _, _ = _residuals(model, pose, targets[k])
        weight = root**2
        square += float(weight @ (residual**2).sum(-1))
        product += float(weight @ (residual * residual[near].mean(1)).sum(-1))
        total += float(weight.sum())
    return 2 * LANDMARK_NOISE**2 * total / square / (1 + GROUP * max(product / square, 0.0))


def _residuals(model: FrameModel, pose: Pose, target: Array) -> tuple[Array, Array, Array, float]:
    """Residuals [L,2] in eye-corner distances, roots of their weights [L], camera-space points [L,3] and the scale."""
    camera = head_landmarks(model, pose) @ pose.rotation.T + pose.translation
    scale = float(camera[:, 2].mean()) / (model.focal * model.unit)
    residual = (model.focal * camera[:, :2] / camera[:, 2:] - target[model.ids]) * scale
    cosine = -((model.normal @ pose.rotation.T) * camera).sum(-1) / np.linalg.norm(camera, axis=-1)
    weight = model.weight * (cosine / LANDMARK_FACING).clip(LANDMARK_HIDDEN_TRUST, 1.0) ** 2
    robust = (FRAME_ROBUST_SCALE**2 / (FRAME_ROBUST_SCALE**2 + (residual**2).sum(-1))) ** 2
    return residual, np.sqrt(weight * robust) / LANDMARK_NOISE, camera, scale
