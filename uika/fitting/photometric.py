"""Follow a face by its own colours: what landmarks miss, the texture of the person shows.

Points on the head surface remember the grey level that key frames showed there. A frame is fitted by moving the head
until the picture at the projected points meets those levels (Lucas-Kanade on the head model), under lighting that may
change smoothly with the surface's direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from uika.fitting.jacobians import level_jacobian
from uika.fitting.weights import GREY_EXPRESSION_PRIOR, GREY_NOISE, GREY_ROBUST_SCALE, POINT_FACING, POINT_VISIBLE
from uika.head import HeadModel, look_at, project, rasterize, uv_texels
from uika.head.axis_angle import Array
from uika.head.landmark_model import (
    FrameModel,
    Pose,
    bounded_step,
    head_landmarks,
    landmark_jacobian,
    moved,
    surface_model,
)

SIDE = 224  # pixels of the face crop that is compared
FRONT_SIZE = 640  # pixels, of the pictures that tell which points are visible
ATLAS = 80  # texels along a side; about 900 of them lie on the face
MARGIN = 1.3  # side of the crop over the landmarks' box
CORRELATED = 3.0  # neighbouring points err together: that many count as one
LIGHT_PRIOR = (100.0, 100.0, 100.0, 100.0)  # per squared change of gain and of its slopes over the normal
STILLNESS = 1.0
SYMMETRY = 10.0  # faces mostly move alike on both sides
CONVERGED = 1e-3
MAX_DAMPING = 1e4


@dataclass(frozen=True)
class Appearance:
    """M surface points of one person, with the grey level [M] in [0,1] they showed and how often that was seen [M]."""

    model: FrameModel
    level: Array
    seen: Array


@dataclass(frozen=True)
class FaceCrop:
    """A square of a frame at the compared size: grey level and its slopes along x and y, [SIDE*SIDE,3]."""

    pixels: NDArray[np.float32]
    corner: Array  # [2] frame pixels, relative to the principal point
    scale: float  # crop pixels per frame pixel


def make_appearance(head: HeadModel, identity: torch.Tensor, focal: float, unit: float) -> Appearance:
    """An appearance that has seen nothing yet, for the visible points of the person's face."""
    triangle, barycentric = _face_points(head)
    model = surface_model(head, identity, focal, unit, triangle, barycentric)
    model = replace(model, basis=model.basis.astype(np.float32))
    blank = np.zeros(len(triangle))
    return Appearance(model, blank, blank)


@lru_cache(maxsize=4)
def _face_points(head: HeadModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangles [M] and barycentrics [M,3] of evenly spread points on face and eyeballs that the mean head shows."""
    binding = uv_texels(head, ATLAS)
    shares = {name: (head.masks[name][head.faces[binding.triangle]] * binding.barycentric).sum(-1)
              for name in ("face", "eyeballs", "mouth_inner")}  # fmt: skip
    wanted = ((shares["face"] > 0.6) | (shares["eyeballs"] > 0.5)) & (shares["mouth_inner"] < 0.5)
    keep = wanted & _in_front(head)[binding.triangle]
    return binding.triangle[keep], binding.barycentric[keep]


def _in_front(head: HeadModel) -> torch.Tensor:
    """Triangles [F] of the neutral face that nothing covers from the front or half sides."""
    seen = torch.zeros(len(head.faces), dtype=torch.bool)
    for yaw in (-30.0, 0.0, 30.0):
        camera = look_at(yaw, 0.0, 1.0, head.joints[3:5].mean(0), fov_y=16.0, size=FRONT_SIZE)
        points, depth = project(head.template, camera)
        triangle, _ = rasterize(points, head.faces, FRONT_SIZE, FRONT_SIZE, depth=depth)
        seen[triangle[triangle >= 0].unique()] = True
    return seen


def crop_face(grey: NDArray[np.uint8], landmarks: Array, centre: Array, blur: float) -> FaceCrop:
    """Cut the face out of a frame.

    Args:
        grey: [H,W] frame.
        landmarks: [478,2] pixels of the frame.
        centre: [2] its principal point.
        blur: standard deviation in crop pixels.
    """
    from PIL import Image, ImageFilter

    low, high = landmarks.min(0), landmarks.max(0)
    side = MARGIN * float((high - low).max())
    corner, step = (low + high - side) / 2, side / SIDE
    affine = (step, 0.0, corner[0], 0.0, step, corner[1])
    image = Image.fromarray(grey).transform((SIDE, SIDE), Image.Transform.AFFINE, affine, Image.Resampling.BILINEAR)
    level = np.asarray(image.filter(ImageFilter.GaussianBlur(blur)), dtype=np.float32) / 255
    down, across = np.gradient(level)
    return FaceCrop(np.stack((level, across, down), -1).reshape(-1, 3), corner - centre, 1 / step)


def add_observation(appearance: Appearance, pose: Pose, view: FaceCrop) -> Appearance:
    """Add what a frame shows at the points to the mean grey levels, by trust."""
    place, camera = place_points(appearance.model, pose, view)
    trust = point_trust(appearance.model, pose, camera)
    total = appearance.seen + trust
    level = appearance.seen * appearance.level + trust * sample(view, place)[:, 0]
    return replace(appearance, level=level / np.maximum(total, 1e-9), seen=total)


def fit_pose(
    appearance: Appearance, views: list[tuple[FaceCrop, int]], guess: Pose, before: Pose, anchor: tuple[Array, Array]
) -> tuple[Pose, float]:
    """Fit a frame to the appearance.

    Args:
        appearance: the person.
        views: the frame from blurred to sharp, each with its number of steps.
        guess: where to start.
        before: the pose of the frame before, whose expression is preferred.
        anchor: a quadratic pull towards the landmarks, matrix [P,P] and gradient [P] at `guess`.

    Returns:
        The pose, and the root mean square difference of grey levels that remains.
    """
    pose, light = guess, np.array([1.0, 0.0, 0.0, 0.0])
    travelled = np.zeros(len(anchor[1]))
    error = 0.0
    for view, steps in views:
        damping = 1e-3
        matrix, gradient, cost, error = _system(appearance, pose, light, view, before, anchor, travelled)
        for _ in range(steps):
            step = bounded_step(appearance.model, pose, matrix + np.diag(damping * np.diagonal(matrix)), gradient)
            trial, trial_light = moved(appearance.model, pose, step[:-4]), light + step[-4:]
            system = _system(appearance, trial, trial_light, view, before, anchor, travelled + step[:-4])
            if system[2] >= cost:
                damping *= 10.0
                if damping > MAX_DAMPING:
                    break
                continue
            done = cost - system[2] < CONVERGED * cost
            pose, light, travelled = trial, trial_light, travelled + step[:-4]
            matrix, gradient, cost, error = system
            damping = max(damping / 10.0, 1e-6)
            if done:
                break
    return pose, error


def along_surface(model: FrameModel, pose: Pose, slope: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Change of level by expressions and joints [M,E+3J], from the slopes [M,3] of the level in head space."""
    jacobian = landmark_jacobian(model, pose) if len(pose.joints) else model.basis[0]
    np.multiply(slope[:, :1], jacobian[:, 0], out=out, casting="same_kind")
    for axis in (1, 2):
        out += slope[:, axis : axis + 1] * jacobian[:, axis]


def place_points(model: FrameModel, pose: Pose, view: FaceCrop) -> tuple[Array, Array]:
    """Crop pixels [M,2] and camera-space points [M,3]."""
    camera = head_landmarks(model, pose) @ pose.rotation.T + pose.translation
    pixels = model.focal * camera[:, :2] / np.maximum(camera[:, 2:], 1e-6)
    return (pixels - view.corner) * view.scale, camera


def point_trust(model: FrameModel, pose: Pose, camera: Array) -> Array:
    """Trust [M] in [0,1] by viewing angle."""
    cosine = -((model.normal @ pose.rotation.T) * camera).sum(-1) / np.linalg.norm(camera, axis=-1)
    return ((cosine - POINT_VISIBLE) / (POINT_FACING - POINT_VISIBLE)).clip(0, 1)


def sample(view: FaceCrop, place: Array) -> Array:
    """Bilinear level and slopes [M,3] at crop pixels [M,2], centres at +0.5; the border repeats."""
    at = (place - 0.5).clip(0, SIDE - 1.001)
    cell = at.astype(np.int64)
    fx, fy = (at - cell).T[..., None]
    index = cell[:, 1] * SIDE + cell[:, 0]
    top = view.pixels[index] * (1 - fx) + view.pixels[index + 1] * fx
    bottom = view.pixels[index + SIDE] * (1 - fx) + view.pixels[index + SIDE + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy)


def _system(
    appearance: Appearance,
    pose: Pose,
    light: Array,
    view: FaceCrop,
    before: Pose,
    anchor: tuple[Array, Array],
    travelled: Array,
) -> tuple[Array, Array, float, float]:
    """Gauss-Newton matrix and gradient over pose and light, cost, and remaining error."""
    model = appearance.model
    place, camera = place_points(model, pose, view)
    values = sample(view, place)
    weight = point_trust(model, pose, camera) * (appearance.seen > 0.3)
    direction = np.concatenate((np.ones((len(camera), 1)), model.normal @ pose.rotation.T), -1)
    lit = appearance.level[:, None] * direction
    residual = values[:, 0] - lit @ light
    square = residual**2
    robust = GREY_ROBUST_SCALE**2 / (GREY_ROBUST_SCALE**2 + square)
    root = np.sqrt(weight / CORRELATED) * robust / GREY_NOISE
    slope = values[:, 1:] * (view.scale * model.focal) / camera[:, 2:]
    d_camera = level_jacobian(slope, camera) * root[:, None]
    E, P = len(pose.expression), len(travelled)
    # Single precision halves the time of the one large product; what it loses is far below the noise.
    jacobian = np.empty((len(camera), P + 4), dtype=np.float32)
    along_surface(model, pose, (d_camera @ pose.rotation).astype(np.float32), jacobian[:, : P - 6])
    jacobian[:, P - 6 : P - 3] = np.cross(camera - pose.translation, d_camera)
    jacobian[:, P - 3 : P] = d_camera
    jacobian[:, P:] = -root[:, None] * lit
    matrix = (jacobian.T @ jacobian).astype(np.float64)
    gradient = (jacobian.T @ (root * residual).astype(np.float32)).astype(np.float64)
    pull, change = pose.expression, pose.expression - before.expression
    index, uneven = np.arange(E), pull - pull[model.twin]
    matrix[index, index] += GREY_EXPRESSION_PRIOR + STILLNESS + SYMMETRY
    matrix[index, model.twin] -= SYMMETRY
    gradient[:E] += GREY_EXPRESSION_PRIOR * pull + STILLNESS * change + SYMMETRY * uneven
    swing = light - (1.0, 0.0, 0.0, 0.0)
    matrix[range(P, P + 4), range(P, P + 4)] += LIGHT_PRIOR
    gradient[P:] += LIGHT_PRIOR * swing
    matrix[:P, :P] += anchor[0]
    gradient[:P] += anchor[1] + anchor[0] @ travelled
    cost = float(weight @ (square * robust)) / (CORRELATED * GREY_NOISE**2) + float(np.array(LIGHT_PRIOR) @ swing**2)
    cost += (
        GREY_EXPRESSION_PRIOR * float(pull @ pull)
        + SYMMETRY / 2 * float(uneven @ uneven)
        + STILLNESS * float(change @ change)
    )
    cost += float(2 * anchor[1] @ travelled + travelled @ anchor[0] @ travelled)
    error = float(np.sqrt((weight * square * robust).sum() / max(weight.sum(), 1e-9)))
    return matrix, gradient, cost, error
