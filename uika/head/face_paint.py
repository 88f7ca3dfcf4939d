"""A head painted and shaded plainly, so that the landmark detector finds its face."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.head import Camera, HeadError, HeadModel, look_at, project, rasterize, vertex_normals

SIZE = 512
DISTANCES = (0.7, 0.9)  # metres
TARGET = (0.0, -0.02, -0.034)  # metres from the middle between the eyes
SKIN = (0.78, 0.58, 0.48)
SCLERA = (0.93, 0.92, 0.9)
LIPS = (0.70, 0.36, 0.34)
BROW = (0.25, 0.17, 0.12)
IRIS = (0.3, 0.2, 0.12)
PUPIL = (0.03, 0.03, 0.03)
IRIS_RADIUS = 0.006  # metres
PUPIL_RADIUS = 0.002  # metres
LIP_SIZE = (0.025, 0.009)  # metres, half axes


def eyeballs(head: HeadModel) -> Tensor:
    """Vertices [V] that belong to the left (1) and the right (2) eyeball, 0 for the others."""
    left, right = head.lbs_weights[:, 3] > 0.5, head.lbs_weights[:, 4] > 0.5
    if not bool(left.any()) or not bool(right.any()):
        raise HeadError(f"head '{head.id}': no vertices follow the eye joints, so its face cannot be painted")
    return left.long() + 2 * right.long()


def front_camera(head: HeadModel, yaw: float = 0.0, distance: float = DISTANCES[0]) -> Camera:
    """A camera before the face of the mean head."""
    target = head.joints[3:5].mean(0) + torch.tensor(TARGET)
    return look_at(yaw, 0.0, distance, target, fov_y=26.0 * DISTANCES[0] / distance, size=SIZE)


def mouth_slit(head: HeadModel) -> Tensor:
    """Point [3] between the closed lips: where the jaw's pull changes most along the middle of the face."""
    camera = front_camera(head)
    points, depth = project(head.template, camera)
    triangle, bary = rasterize(points, head.faces, SIZE, SIZE, depth=depth)
    chin_to_eyes = project(torch.stack((head.joints[3:5].mean(0), head.joints[2])), camera)[0]
    column = SIZE // 2
    rows = torch.arange(int(chin_to_eyes[0, 1]), SIZE)
    rows = rows[triangle[rows, column] >= 0]
    corners, mix = head.faces[triangle[rows, column]], bary[rows, column][..., None]
    pull = (head.lbs_weights[:, 2][corners] * mix[..., 0]).sum(-1)
    place = (head.template[corners] * mix).sum(1)
    step = (pull[3:] - pull[:-3]) / (place[3:] - place[:-3]).norm(dim=-1).clamp_min(1e-3)
    return place[int(step.argmax()) + 1]


def paint(head: HeadModel) -> Tensor:
    """Plain face paint [V,3], sRGB: enough for the detector to find eyes, brows and lips."""
    points = head.template
    colours = torch.tensor(SKIN).repeat(len(points), 1)
    normals = vertex_normals(points, head.faces)
    side = eyeballs(head)
    slit = mouth_slit(head)
    from_slit = (points - slit)[:, :2] / torch.tensor(LIP_SIZE)
    lips = (from_slit.square().sum(-1) < 1) & (normals[:, 2] > 0) & (points[:, 2] > slit[2] - 0.02)
    colours[lips] = torch.tensor(LIPS)
    for which in (1, 2):
        ball = side == which
        colours[ball] = torch.tensor(SCLERA)
        middle = points[ball][points[ball, 2].argmax()]
        distance = (points - middle).norm(dim=-1)
        colours[ball & (distance < IRIS_RADIUS)] = torch.tensor(IRIS)
        colours[ball & (distance < PUPIL_RADIUS)] = torch.tensor(PUPIL)
        dx, dy = (points[:, 0] - 1.02 * middle[0]).abs(), points[:, 1] - middle[1]
        brow = (dx < 0.021) & ((dy - 0.0215 + 6.0 * dx**2).abs() < 0.0045) & (points[:, 2] > middle[2] - 0.03)
        colours[brow & (side == 0)] = torch.tensor(BROW)
    return colours


def shade(vertices: Tensor, faces: Tensor, colours: Tensor, camera: Camera) -> tuple[np.ndarray, Tensor, Tensor]:
    """8-bit picture [H,W,3] of a lit mesh, with the triangle [H,W] and barycentrics [H,W,3] behind each pixel."""
    points, depth = project(vertices, camera)
    triangle, bary = rasterize(points, faces, camera.height, camera.width, depth=depth)
    corners = faces[triangle.clamp(min=0)]
    normal = normalize((vertex_normals(vertices, faces)[corners] * bary[..., None]).sum(-2), dim=-1)
    light = normalize(torch.tensor([0.2, 0.4, 1.0]), dim=0)
    lit = (colours[corners] * bary[..., None]).sum(-2) * (0.35 + 0.65 * (normal @ light).clamp(min=0))[..., None]
    image = torch.where((triangle >= 0)[..., None], lit, torch.tensor(0.85))
    return (image.clamp(0, 1) ** (1 / 1.1) * 255).to(torch.uint8).numpy(), triangle, bary
