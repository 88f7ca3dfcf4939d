"""Landmark embedding: the face mesh detector looks at pictures of a painted head; each hit is a point on the mesh."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.head import HeadError, HeadModel, vertex_normals
from uika.head.face_paint import DISTANCES, SIZE, front_camera, shade

YAWS = (0.0, -29.0, 29.0, -14.0, 14.0)
MESH_POINTS = 478
MIN_VIEWS = 3
MIN_COSINE = 0.35
TRUSTED_SNAP = 0.004  # metres between the mean of the hits and the surface


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
    from uika.photo.networks import face_meshes

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
    corners = vertices[faces]  # [F,3,3]
    middles = corners.mean(1)
    reach = (corners - middles[:, None]).norm(dim=-1).amax(1)
    results = []
    for part in points.split(chunk):
        away = (part[:, None] - middles).norm(dim=-1)
        # A triangle no part of which can be closer than another's middle need not be looked at.
        close = away - reach <= away.amin(1, keepdim=True) + 1e-6
        order = close.to(torch.int8).topk(int(close.sum(1).max()), dim=1).indices.sort(dim=1).values
        triangle, mix, distance = _nearest(part[:, None], *corners[order].unbind(2))
        results.append((order.gather(1, triangle[:, None])[:, 0], mix, distance))
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
