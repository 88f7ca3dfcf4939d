"""Soft vertex masks of a head from its geometry, its joints and its landmarks, where it brings none of its own."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.head import HeadModel, look_at, project, rasterize, vertex_normals
from uika.head.face_paint import eyeballs, mouth_slit

# Outlines in the 478-point face mesh.
FACE_OVAL = (
    10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377,
    152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109,
)  # fmt: skip
OUTER_LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
EYES = (
    (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246),
    (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466),
)
CHIN, NOSE_BASE, BROWS = 152, 2, (105, 334)
EAR_REACH = 0.055  # metres around the outermost vertex
EAR_RELIEF, EAR_ROUNDS = 0.003, 120  # metres that an ear stands out sideways of the head smoothed so often
MOUTH_REACH = 0.06  # metres behind the lips
LOOK_SIZE = 160  # pixels over that reach on both sides, 0.8 mm each
VIEWS = tuple((yaw, pitch) for yaw in range(-180, 180, 30) for pitch in (-40, 0, 40))


def region_masks(head: HeadModel) -> dict[str, Tensor]:
    """Weights [V] in [0,1]: face, lips, eyes, ears, scalp, neck, mouth_inner and eyeballs; needs landmarks."""
    points = head.template
    marks = dict(zip(head.landmark_ids.tolist(), head.landmarks(points), strict=True))
    balls = eyeballs(head) > 0
    inner = _inner_mouth(head, marks, balls)
    skin = ~balls & ~inner
    ears = _ears(head, skin)
    face = _inside(head, marks, FACE_OVAL, depth=0.10) & (points[:, 2] > _z(marks, FACE_OVAL) - 0.01)
    face_soft = _smooth((face & skin & ~ears).float(), head.faces, 2) * skin
    lips = _inside(head, marks, OUTER_LIPS, depth=0.05) & skin & (points[:, 2] > _z(marks, OUTER_LIPS) - 0.02)
    eyes = torch.zeros(len(points))
    for contour in EYES:
        ring = torch.stack([marks[i] for i in contour if i in marks])
        eyes = torch.maximum(eyes, (1.6 - torch.cdist(points, ring).amin(1) / 0.008).clamp(0, 1))
    below_ears = points[ears, 1].min() if bool(ears.any()) else marks[CHIN][1] + 0.03
    neck_line = _ramp(points[:, 2], (-0.08, 0.02, 0.07), (below_ears - 0.02, marks[CHIN][1], marks[CHIN][1] - 0.01))
    neck = _smooth((points[:, 1] < neck_line).float(), head.faces, 3) * skin * (1 - face_soft)
    brow = torch.stack([marks[i][1] for i in BROWS if i in marks]).max()
    depth = points[:, 2] - (head.joints[3:5, 2].mean() - 0.034)
    hairline = _ramp(depth, (-0.02, 0.04, 0.09), (below_ears - 0.01, brow - 0.01, brow + 0.045))
    scalp = (points[:, 1] > hairline) | ((depth < -0.015) & (points[:, 1] > below_ears - 0.02))
    scalp_soft = _smooth((scalp & skin & ~ears).float(), head.faces, 4) * skin * (1 - ears.float())
    return {
        "face": face_soft,
        "lips": _smooth(lips.float(), head.faces, 1) * skin,
        "eyes": eyes * skin,
        "ears": _smooth(ears.float(), head.faces, 1) * skin,
        "scalp": scalp_soft,
        "neck": neck,
        "mouth_inner": inner.float(),
        "eyeballs": balls.float(),
    }


def _smooth(values: Tensor, faces: Tensor, rounds: int) -> Tensor:
    """Vertex values [V] or [V,C], each averaged half and half with its neighbours `rounds` times."""
    count = len(values)
    one, other = torch.cat((faces, faces.roll(1, 1))).flatten(), torch.cat((faces.roll(1, 1), faces)).flatten()
    pairs = (one * count + other).unique()  # of numbers, which is much faster than of rows
    start, end = pairs // count, pairs % count
    degree = torch.bincount(start, minlength=count).clamp_min(1).to(values.dtype)
    for _ in range(rounds):
        total = torch.zeros_like(values).index_add(0, start, values[end])
        values = 0.5 * values + 0.5 * total / degree.view(-1, *(1,) * (values.ndim - 1))
    return values


def _z(marks: dict[int, Tensor], outline: tuple[int, ...]) -> Tensor:
    return torch.stack([marks[i][2] for i in outline if i in marks]).min()


def _inside(head: HeadModel, marks: dict[int, Tensor], outline: tuple[int, ...], depth: float) -> Tensor:
    """Vertices [V] inside a landmark outline, seen from a point `depth` metres behind its middle."""
    ring = torch.stack([marks[i] for i in outline if i in marks])
    eye = ring.mean(0) - torch.tensor([0.0, 0.0, depth])
    rays, edge = head.template - eye, ring - eye
    place = rays[:, :2] / rays[:, 2:].clamp_min(1e-3)
    corners = edge[:, :2] / edge[:, 2:].clamp_min(1e-3)
    ahead = corners.roll(-1, 0)
    # Even-odd rule: count the edges that a ray to the right crosses.
    spans = (corners[:, 1] > place[:, 1:]) != (ahead[:, 1] > place[:, 1:])
    rise = torch.where((ahead - corners)[:, 1].abs() < 1e-9, 1e-9, (ahead - corners)[:, 1])
    crossing = corners[:, 0] + (place[:, 1:] - corners[:, 1]) / rise * (ahead - corners)[:, 0]
    return ((spans & (place[:, :1] < crossing)).sum(1) % 2 == 1) & (rays[:, 2] > 0)


def _ramp(at: Tensor, knots: tuple[float, ...], values: tuple[float | Tensor, ...]) -> Tensor:
    """Piecewise linear function, constant outside the knots."""
    result = torch.full_like(at, float(values[0]))
    for k in range(len(knots) - 1):
        share = ((at - knots[k]) / (knots[k + 1] - knots[k])).clamp(0, 1)
        result = result + share * (float(values[k + 1]) - float(values[k]))
    return result


def _ears(head: HeadModel, skin: Tensor) -> Tensor:
    points = head.template
    # Sideways only: smoothing an ear draws the skull around it outwards just as far.
    relief = points[:, 0] - _smooth(points[:, 0], head.faces, EAR_ROUNDS)
    middle = head.joints[3:5].mean(0)
    height = points[:, 1] - middle[1]
    level = skin & (height > -0.06) & (height < 0.04) & (points[:, 2] < middle[2] - 0.03)
    ears = torch.zeros(len(points), dtype=torch.bool)
    for side in (-1.0, 1.0):
        outward = torch.where(level, side * points[:, 0], -torch.inf)
        tip = points[int(outward.argmax())]
        ears |= level & ((points - tip).norm(dim=-1) < EAR_REACH) & (side * relief > EAR_RELIEF)
    return ears


def _inner_mouth(head: HeadModel, marks: dict[int, Tensor], balls: Tensor) -> Tensor:
    """Vertices near the lips that nobody outside ever sees while the mouth is shut."""
    slit = mouth_slit(head)
    near = (head.template - slit).norm(dim=-1) < MOUTH_REACH
    top = marks[NOSE_BASE][1] if NOSE_BASE in marks else slit[1] + 0.02
    hidden = near & ~balls & ~_visible(head, slit) & (head.template[:, 2] < slit[2]) & (head.template[:, 1] < top)
    return hidden


def _visible(head: HeadModel, centre: Tensor) -> Tensor:
    """Vertices [V] of triangles within `MOUTH_REACH` of the centre [3] that some camera around the head sees."""
    seen = torch.zeros(len(head.template), dtype=torch.bool)
    middle = (head.template.amin(0) + head.template.amax(0)) / 2
    radius = float((head.template - middle).norm(dim=-1).max())
    field = 2 * math.degrees(math.atan(1.1 * MOUTH_REACH / (4 * radius)))
    facing = normalize(vertex_normals(head.template, head.faces), dim=-1)
    for yaw, pitch in VIEWS:
        camera = look_at(yaw, pitch, 4 * radius, centre, fov_y=field, size=LOOK_SIZE)
        points, depth = project(head.template, camera)
        triangle, _ = rasterize(points, head.faces, LOOK_SIZE, LOOK_SIZE, depth=depth)
        hit = head.faces[triangle[triangle >= 0].unique()].unique()
        towards = (facing[hit] * (camera.position - head.template[hit])).sum(-1) > 0
        seen[hit[towards]] = True
    return seen
