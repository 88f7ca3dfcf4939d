"""Fit one identity and, for each photo, expression, pose and a pinhole camera to face-mesh landmarks.

A damped Gauss-Newton solve with closed-form Jacobians: landmarks are linear in identity and expression, so a step costs
milliseconds. The photos couple only through the identity, which a Schur complement exploits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.fitting.jacobians import projection_jacobian
from uika.fitting.normal_equations import own_steps, shared_steps
from uika.fitting.surface_marks import SurfaceMarks
from uika.fitting.weights import (
    LANDMARK_EXPRESSION_PRIOR,
    LANDMARK_FACING,
    LANDMARK_HIDDEN_TRUST,
    LANDMARK_NOISE,
    MARK_ROBUST_SCALE,
    MARK_SHARE,
    PHOTO_ROBUST_SCALE,
)
from uika.head import HeadModel, vertex_normals
from uika.head.landmark_model import CONTOUR_WEIGHT, EYELIDS, LIPS, UNFITTED

MESH_POINTS = 478
FIRST_IRIS = 468
EYE_CORNERS = (33, 263)  # outer corners of the right and left eye

IDENTITY_PRIOR = (3.0, 1.2)  # weights of |identity|^2 in the two rounds
BOUND_WEIGHT = 60.0  # soft walls at activations 0 and 1
DISTANCE, DISTANCE_SPREAD = 1.1, 0.35  # metres and log-spread: focal length and distance trade off on one photo
LENS_SPREAD = 0.05  # log-spread of focal lengths that cameras note
STEPS = (12, 18)
MAX_DAMPING = 1e9
TURN_POWER = 3  # of the cosine of a face's turn, by which photos count


@dataclass(frozen=True)
class LandmarkFit:
    """N fitted photos; all float64.

    identity [K]; expression [N,E]; rotation [N,3,3] and translation [N,3] (head to camera, metres); focal [N] pixels;
    error [N] mean landmark distance in outer eye-corner distances (measured in 3D scale, so that it holds in profile).
    """

    identity: Tensor
    expression: Tensor
    rotation: Tensor
    translation: Tensor
    focal: Tensor
    error: Tensor


@dataclass(frozen=True)
class _Problem:
    points: Tensor  # [L,3] mean landmarks, surface marks behind them
    identity: Tensor  # [K,L,3]
    expression: Tensor  # [E,L,3]
    target: Tensor  # [N,L,2] pixels relative to the principal point
    weight: Tensor  # [N,L]
    normal: Tensor  # [L,3] of the mean head
    shape_rows: Tensor  # [L] 1 where the landmark tells about identity
    free: Tensor  # [E] 1 where the expression is fitted
    pixel_unit: Tensor  # [N] pixels of one outer eye-corner distance
    lens: Tensor  # [N] pixels, the noted focal length; NaN where there is none
    identity_prior: float
    known: bool  # whether the identity stays as it is
    scale: Tensor  # [L] of robust errors
    landmarks: int  # how many of the points a detector found


def fit_landmarks(
    landmarks: Tensor,
    head: HeadModel,
    size: int,
    identity: Tensor | None = None,
    focal: Tensor | None = None,
    marks: SurfaceMarks | None = None,
) -> LandmarkFit:
    """Fit the head to N photos.

    Args:
        landmarks: [N,478,2] pixels in square crops of `size`, centres at +0.5.
        head: the head model (with its landmark embedding).
        size: side of the crops; the principal point is taken at the centre.
        identity: [K] of a person known from before; None fits it too.
        focal: [N] pixels that the cameras noted, NaN where one did not; None if none did.
        marks: more points of the surface whose places are known.

    Raises:
        ValueError: the landmarks have another shape or are not finite, or a focal length is not positive.
    """
    if landmarks.ndim != 3 or landmarks.shape[1:] != (MESH_POINTS, 2) or len(landmarks) == 0:
        raise ValueError(f"landmarks: need [N,{MESH_POINTS},2] with N >= 1, got {tuple(landmarks.shape)}")
    if not torch.isfinite(landmarks).all():
        raise ValueError("landmarks: all values must be finite")
    if focal is not None and (focal.shape != landmarks.shape[:1] or bool((focal <= 0).any())):
        raise ValueError(f"focal: need {len(landmarks)} positive numbers of pixels or NaN, got {focal.tolist()}")
    exact = head.to(torch.float64)
    K, E = len(exact.identity_basis), len(exact.expression_names)
    ids = exact.landmark_ids
    weight = exact.landmark_weights.clone()
    weight[torch.isin(ids, torch.tensor(EYELIDS + LIPS))] *= CONTOUR_WEIGHT
    N = len(landmarks)
    problem = _Problem(
        points=exact.landmarks(exact.template),
        identity=exact.landmarks(exact.identity_basis),
        expression=exact.landmarks(exact.expression_basis),
        target=landmarks.double()[:, ids] - size / 2,
        weight=(weight / weight.mean()).expand(N, -1),
        normal=normalize(exact.landmarks(vertex_normals(exact.template, exact.faces)), dim=-1),
        shape_rows=(ids < FIRST_IRIS).double(),
        free=torch.tensor([name not in UNFITTED for name in exact.expression_names], dtype=torch.float64),
        pixel_unit=torch.ones(N, dtype=torch.float64),
        lens=torch.full((N,), torch.nan, dtype=torch.float64) if focal is None else focal.double(),
        identity_prior=IDENTITY_PRIOR[0],
        known=identity is not None,
        scale=torch.full((len(ids),), PHOTO_ROBUST_SCALE, dtype=torch.float64),
        landmarks=len(ids),
    )
    rotation, translation, pixels, unit = _weak_perspective(problem, eye_distance(exact))
    problem = replace(problem, pixel_unit=unit)
    if marks is not None:
        problem = _with_marks(problem, exact, marks, size)
    state = LandmarkFit(
        torch.zeros(K, dtype=torch.float64) if identity is None else identity.double(),
        torch.zeros(N, E, dtype=torch.float64),
        rotation,
        translation,
        pixels,
        torch.zeros(N, dtype=torch.float64),
    )
    for prior, steps in zip(IDENTITY_PRIOR, STEPS, strict=True):
        seen = problem.weight * _facing(problem, state)
        state = _solve(replace(problem, weight=seen, identity_prior=prior), state, steps)
    distance = (_project(problem, state)[0] - problem.target).norm(dim=-1)[:, : problem.landmarks]
    return replace(state, error=distance.mean(-1) / problem.pixel_unit)


def _with_marks(problem: _Problem, exact: HeadModel, marks: SurfaceMarks, size: int) -> _Problem:
    """The problem with surface marks; together they weigh `MARK_SHARE` of what a photo's landmarks do."""
    trust = marks.weight.double()
    share = MARK_SHARE * problem.landmarks / trust.sum(1, keepdim=True).clamp_min(0.2 * trust.shape[1])
    normal = marks.on(exact, vertex_normals(exact.template, exact.faces))
    return replace(
        problem,
        points=torch.cat((problem.points, marks.on(exact, exact.template))),
        identity=torch.cat((problem.identity, marks.on(exact, exact.identity_basis)), 1),
        expression=torch.cat((problem.expression, marks.on(exact, exact.expression_basis)), 1),
        target=torch.cat((problem.target, marks.place.double() - size / 2), 1),
        weight=torch.cat((problem.weight, share * trust), 1),
        normal=torch.cat((problem.normal, normalize(normal, dim=-1))),
        shape_rows=torch.cat((problem.shape_rows, torch.ones(trust.shape[1], dtype=torch.float64))),
        scale=torch.cat((problem.scale, torch.full(trust.shape[1:], MARK_ROBUST_SCALE, dtype=torch.float64))),
    )


def eye_distance(head: HeadModel) -> float:
    """Metres between the outer eye corners of the mean head."""
    points = head.landmarks(head.template)
    at = [int(torch.nonzero(head.landmark_ids == corner)[0]) for corner in EYE_CORNERS]
    return float((points[at[0]] - points[at[1]]).norm())


def _weak_perspective(problem: _Problem, eye_distance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Start: the affine camera of the mean head by linear least squares, made a rotation at the likely distance."""
    centre = problem.points.mean(0)
    shape = problem.points - centre
    middle = problem.target.mean(1)
    affine = torch.linalg.lstsq(shape.expand(len(middle), -1, -1), problem.target - middle[:, None]).solution.mT
    u, s, vt = torch.linalg.svd(affine, full_matrices=False)
    rows = u @ vt
    scale = s.mean(-1)
    rotation = torch.stack((rows[:, 0], rows[:, 1], torch.linalg.cross(rows[:, 0], rows[:, 1])), 1)
    focal = torch.where(problem.lens.isnan(), scale * DISTANCE, problem.lens)
    depth = focal / scale
    translation = torch.cat((middle / scale[:, None], depth[:, None]), -1) - rotation @ centre
    return rotation, translation, focal, scale * eye_distance


def _project(problem: _Problem, state: LandmarkFit) -> tuple[Tensor, Tensor]:
    """Pixels [N,L,2] relative to the principal point, and camera-space points [N,L,3]."""
    points = problem.points + torch.einsum("k,klc->lc", state.identity, problem.identity)
    points = points + torch.einsum("ne,elc->nlc", state.expression, problem.expression)
    camera = points @ state.rotation.mT + state.translation[:, None]
    return state.focal[:, None, None] * camera[..., :2] / camera[..., 2:], camera


def _facing(problem: _Problem, state: LandmarkFit) -> Tensor:
    """Trust [N,L] by viewing angle: the detector guesses what is turned away, and its guesses are biased.

    Photos are compared with the most frontal one, so that a lone photo is believed.
    """
    _, camera = _project(problem, state)
    cosine = -(problem.normal @ state.rotation.mT * normalize(camera, dim=-1)).sum(-1)
    frontal = state.rotation[:, 2, 2].abs()
    # A detector's marks are biased on turned faces, those of the surface are not.
    photo = (frontal / frontal.max())[:, None] ** TURN_POWER * torch.ones_like(cosine)
    photo[:, problem.landmarks :] = 1.0
    return (cosine / LANDMARK_FACING).clamp(LANDMARK_HIDDEN_TRUST, 1.0).square() * photo


def _cost(problem: _Problem, state: LandmarkFit) -> Tensor:
    pixels, camera = _project(problem, state)
    square = ((pixels - problem.target) / problem.pixel_unit[:, None, None]).square().sum(-1)
    robust = problem.scale**2 * square / (problem.scale**2 + square) / LANDMARK_NOISE**2
    outside = state.expression - state.expression.clamp(0, 1)
    cost = (problem.weight * robust).sum() + problem.identity_prior * state.identity.square().sum()
    cost = cost + LANDMARK_EXPRESSION_PRIOR * state.expression.square().sum() + BOUND_WEIGHT * outside.square().sum()
    near = (state.translation[:, 2].clamp(min=1e-3) / DISTANCE).log() / DISTANCE_SPREAD
    wide = (state.focal / problem.lens).log() / LENS_SPREAD
    cost = cost + torch.where(problem.lens.isnan(), near, wide).square().sum()
    behind = (camera[..., 2] <= 1e-3).any()
    return torch.where(behind, torch.full_like(cost, torch.inf), cost)


def _solve(problem: _Problem, state: LandmarkFit, steps: int) -> LandmarkFit:
    damping, cost = 1e-3, _cost(problem, state)
    for _ in range(steps):
        system = _normal_equations(problem, state)
        while damping < MAX_DAMPING:
            trial = _apply(state, *(own_steps if problem.known else shared_steps)(*system, damping))
            trial_cost = _cost(problem, trial)
            if trial_cost <= cost:
                break
            damping *= 8.0
        else:
            return state
        state, cost, damping = trial, trial_cost, max(damping / 5.0, 1e-6)
    return state


def _normal_equations(problem: _Problem, state: LandmarkFit) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Blocks A [K,K], B [N,K,P], C [N,P,P] of the Gauss-Newton matrix and right sides a [K], c [N,P]; P = E + 7."""
    pixels, camera = _project(problem, state)
    N, L = pixels.shape[:2]
    E = state.expression.shape[1]
    residual = (pixels - problem.target) / problem.pixel_unit[:, None, None]
    robust = (problem.scale**2 / (problem.scale**2 + residual.square().sum(-1))).square()
    root = (problem.weight * robust).sqrt()[..., None] / LANDMARK_NOISE
    focal = state.focal[:, None] / problem.pixel_unit[:, None]
    d_camera = torch.from_numpy(projection_jacobian(camera.numpy(), focal.numpy()))
    d_head = d_camera @ state.rotation[:, None]
    j_shape = torch.einsum("nlij,klj->nlik", d_head, problem.identity) * problem.shape_rows[:, None, None]
    j_expression = torch.einsum("nlij,elj->nlie", d_head, problem.expression) * problem.free
    turned = camera - state.translation[:, None]
    cross = torch.zeros(N, L, 3, 3, dtype=camera.dtype)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = turned[..., 2], -turned[..., 1], turned[..., 0]
    cross = cross - cross.mT
    d_focal = (pixels / problem.pixel_unit[:, None, None])[..., None]
    j_photo = torch.cat((j_expression, d_camera @ cross, d_camera, d_focal), -1)
    rows = (root * residual).reshape(N, -1, 1)
    j_shape = (root[..., None] * j_shape).reshape(N, 2 * L, -1)
    j_photo = (root[..., None] * j_photo).reshape(N, 2 * L, -1)
    A = (j_shape.mT @ j_shape).sum(0)
    B = j_shape.mT @ j_photo
    C = j_photo.mT @ j_photo
    a = (j_shape.mT @ rows).sum(0)[:, 0]
    c = (j_photo.mT @ rows)[..., 0]
    A.diagonal().add_(problem.identity_prior)
    a = a + problem.identity_prior * state.identity
    outside = state.expression - state.expression.clamp(0, 1)
    curvature = LANDMARK_EXPRESSION_PRIOR + BOUND_WEIGHT * (outside != 0).double()
    C.diagonal(dim1=-2, dim2=-1)[:, :E].add_(curvature)
    c[:, :E] += LANDMARK_EXPRESSION_PRIOR * state.expression + BOUND_WEIGHT * outside
    depth, noted = state.translation[:, 2], ~problem.lens.isnan()
    slope = ~noted / (DISTANCE_SPREAD * depth)
    C[:, E + 5, E + 5] += slope.square()
    c[:, E + 5] += slope * (depth / DISTANCE).log() / DISTANCE_SPREAD
    C[:, E + 6, E + 6] += noted / LENS_SPREAD**2
    c[:, E + 6] += torch.where(noted, (state.focal / problem.lens).log() / LENS_SPREAD**2, 0.0)
    return A, B, C, a, c


def _apply(state: LandmarkFit, shared: Tensor, photos: Tensor) -> LandmarkFit:
    E = state.expression.shape[1]
    turn = torch.zeros(len(photos), 3, 3, dtype=photos.dtype)
    w = photos[:, E : E + 3]
    turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0] = w[:, 0], w[:, 1], w[:, 2]
    return replace(
        state,
        identity=state.identity + shared,
        expression=state.expression + photos[:, :E],
        rotation=torch.linalg.matrix_exp(turn - turn.mT) @ state.rotation,
        translation=state.translation + photos[:, E + 3 : E + 6],
        focal=state.focal * photos[:, E + 6].clamp(-0.5, 0.5).exp(),
    )
