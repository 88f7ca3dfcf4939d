"""Landmark embedding: the face mesh detector looks at pictures of a painted head; each hit is a point on the mesh."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.head import Camera, HeadError, HeadModel, look_at, project, rasterize, vertex_normals

SIZE = 512
YAWS = (0.0, -29.0, 29.0, -14.0, 14.0)
DISTANCES = (0.7, 0.9)  # metres
TARGET = (0.0, -0.02, -0.034)  # metres from the middle between the eyes
MESH_POINTS = 478
MIN_VIEWS = 3
MIN_COSINE = 0.35
TRUSTED_SNAP = 0.004  # metres between the mean of the hits and the surface
SKIN, SCLERA = (0.78, 0.58, 0.48), (0.93, 0.92, 0.9)
LIPS, BROW, IRIS, PUPIL = (0.70, 0.36, 0.34), (0.25, 0.17, 0.12), (0.3, 0.2, 0.12), (0.03, 0.03, 0.03)
IRIS_RADIUS, PUPIL_RADIUS = 0.006, 0.002  # metres
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


def embed(head: HeadModel, colours: Tensor, keep: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Embed the 478 mesh points.

    Args:
        head: the head; its mean face is painted with `colours` [V,3] and shown to the detector from several sides.
        colours: sRGB in [0,1].
        keep: [F] bool, triangles that a landmark may lie on.

    Returns:
        Landmark ids [L], triangles [L], barycentrics [L,3] and weights [L] in (0,1].

    Raises:
        HeadError: the detector finds no face in most of the pictures.
    """
    from uika.photo.nets import face_meshes

    points, faces = head.template, head.faces
    normals = vertex_normals(points, faces)
    total, weight = torch.zeros(MESH_POINTS, 3), torch.zeros(MESH_POINTS)
    cameras = [front_camera(head, yaw, distance) for yaw in YAWS for distance in DISTANCES]
    pictures = [shade(points, faces, colours, camera) for camera in cameras]
    meshes = face_meshes([picture for picture, _, _ in pictures])
    for camera, (_, hit, bary), mesh in zip(cameras, pictures, meshes, strict=True):
        if mesh is None:
            continue
        cell = torch.from_numpy(mesh).floor().long()
        inside = ((cell >= 0) & (cell < SIZE)).all(-1)
        col, row = cell.clamp(0, SIZE - 1).unbind(-1)
        triangle, mix = hit[row, col], bary[row, col][..., None]
        inside &= (triangle >= 0) & keep[triangle.clamp_min(0)]
        corners = faces[triangle.clamp_min(0)]
        place = (points[corners] * mix).sum(1)
        normal = normalize((normals[corners] * mix).sum(1), dim=-1)
        cosine = (normal * normalize(camera.position - place, dim=-1)).sum(-1)
        trust = torch.where(inside & (cosine > MIN_COSINE), cosine.square(), 0.0)
        total += trust[:, None] * place
        weight += trust
    found = sum(mesh is not None for mesh in meshes)
    if found < MIN_VIEWS:
        raise HeadError(f"head '{head.id}': the detector found a face in only {found} of {len(cameras)} pictures of it")
    ids = weight.nonzero()[:, 0]
    candidates = keep.nonzero()[:, 0]
    triangle, mix, distance = nearest(total[ids] / weight[ids, None], points, faces[candidates])
    trust = torch.exp(-0.5 * (distance / TRUSTED_SNAP) ** 2).clamp(0.05, 1.0)
    return ids, candidates[triangle], mix, trust


def nearest(points: Tensor, vertices: Tensor, faces: Tensor, chunk: int = 64) -> tuple[Tensor, Tensor, Tensor]:
    """Closest place on a mesh to each point [N,3]: triangle [N], barycentrics [N,3] and distance [N] in metres."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    results = [_nearest(part[:, None], a, b, c) for part in points.split(chunk)]
    triangle, mix, distance = (torch.cat(parts) for parts in zip(*results, strict=True))
    return triangle, mix, distance


def _nearest(points: Tensor, a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    candidates = [_inside(points, a, b, c)]
    for start, end, corners in ((a, b, (0, 1)), (b, c, (1, 2)), (c, a, (2, 0))):
        run = end - start
        share = (((points - start) * run).sum(-1) / run.square().sum(-1).clamp_min(1e-18)).clamp(0, 1)
        mix = points.new_zeros(*share.shape, 3)
        mix[..., corners[0]], mix[..., corners[1]] = 1 - share, share
        candidates.append(mix)
    mixes = torch.stack(candidates)
    place = mixes[..., :1] * a + mixes[..., 1:2] * b + mixes[..., 2:] * c
    distance = torch.where((mixes >= 0).all(-1), (place - points).norm(dim=-1), torch.inf)
    best, triangle = distance.amin(0).min(-1)
    rows = torch.arange(len(points))
    kind = distance[:, rows, triangle].argmin(0)
    return triangle, mixes[kind, rows, triangle], best


def _inside(points: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Barycentrics [N,F,3] of the points' feet on the triangles' planes; negative outside."""
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    wu, wv = (w * u).sum(-1), (w * v).sum(-1)
    scale = uu * vv - uv * uv
    safe = torch.where(scale > 1e-24, scale, 1.0)
    second, third = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    mix = torch.stack((1 - second - third, second, third), -1)
    return torch.where((scale > 1e-24)[..., None], mix, -1.0)
