"""Landmark embedding: the face mesh detector looks at renders of the mean head, each hit is a point on the mesh."""

import numpy as np
import torch

from uika.head import Camera, look_at, project, rasterize, vertex_normals
from uika.photo.networks import face_meshes

from .topology import PARTS

SIZE = 512
YAWS = (0.0, -29.0, 29.0, -14.0, 14.0)
COLOURS = {"skin": (0.78, 0.58, 0.48), "eyes": (0.93, 0.92, 0.9), "mouth": (0.3, 0.1, 0.1), "neck": (0.78, 0.58, 0.48)}
LIPS, BROW, IRIS, PUPIL = (0.70, 0.36, 0.34), (0.25, 0.17, 0.12), (0.3, 0.2, 0.12), (0.03, 0.03, 0.03)
MIN_COSINE = 0.35


def vertex_colours(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, lips: np.ndarray) -> np.ndarray:
    """Plain face paint [V,3]: enough for the detector to find lips and eyes."""
    colours = np.tile(COLOURS["skin"], (len(vertices), 1))
    for name in ("mouth", "neck", "eyes"):
        colours[np.unique(faces[part == PARTS.index(name)])] = COLOURS[name]
    amount = np.clip(lips / lips.max() * 2.0, 0, 1)[:, None]
    colours = colours * (1 - amount) + np.array(LIPS) * amount
    for side in (-1.0, 1.0):
        eye = np.unique(faces[part == PARTS.index("eyes")])
        eye = eye[np.sign(vertices[eye, 0]) == side]
        middle = vertices[eye[np.argmax(vertices[eye, 2])]]
        distance = np.linalg.norm(vertices[eye, :2] - middle[:2], axis=1)
        colours[eye[distance < 0.006]] = IRIS
        colours[eye[distance < 0.002]] = PUPIL
        skin = np.unique(faces[part == PARTS.index("skin")])
        dx, dy = np.abs(vertices[skin, 0] - middle[0] * 1.02), vertices[skin, 1] - middle[1]
        brow = (dx < 0.021) & (np.abs(dy - 0.0215 + 6.0 * dx**2) < 0.0045) & (vertices[skin, 2] > 0)
        colours[skin[brow]] = BROW
    return colours


def shade(
    vertices: torch.Tensor, faces: torch.Tensor, colours: torch.Tensor, camera: Camera
) -> tuple[np.ndarray, torch.Tensor, torch.Tensor]:
    """8-bit picture [H,W,3] of a lit mesh, with the triangle [H,W] and barycentrics [H,W,3] behind each pixel."""
    points, depth = project(vertices, camera)
    triangle, bary = rasterize(points, faces, camera.height, camera.width, depth=depth)
    corners = faces[triangle.clamp(min=0)]
    normal = (vertex_normals(vertices, faces)[corners] * bary[..., None]).sum(-2)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    light = torch.nn.functional.normalize(torch.tensor([0.2, 0.4, 1.0]), dim=0)
    lit = (colours[corners] * bary[..., None]).sum(-2) * (0.35 + 0.65 * (normal @ light).clamp(min=0))[..., None]
    image = torch.where((triangle >= 0)[..., None], lit, torch.tensor(0.85))
    return (image.clamp(0, 1) ** (1 / 1.1) * 255).to(torch.uint8).numpy(), triangle, bary


def embed(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Embed the 478 mesh points.

    Args:
        vertices, faces: the mean head. colours: [V,3] paint. keep: [F] triangles a landmark may lie on.

    Returns:
        landmark ids [L], triangles [L], barycentrics [L,3], weights [L].
    """
    points = torch.as_tensor(vertices, dtype=torch.float32)
    triangles = torch.as_tensor(faces)
    paint = torch.as_tensor(colours, dtype=torch.float32)
    normals = vertex_normals(points, triangles)
    total, weight = np.zeros((478, 3)), np.zeros(478)
    found = 0
    for yaw in YAWS:
        for distance in (0.7, 0.9):
            camera = look_at(yaw, 0.0, distance, target=(0.0, -0.01, 0.0), fov_y=26.0 * 0.7 / distance, size=SIZE)
            image, hit, bary = shade(points, triangles, paint, camera)
            marks = face_meshes([image])[0]
            if marks is None:
                continue
            found += 1
            col, row = np.floor(marks).astype(int).T
            inside = (col >= 0) & (col < SIZE) & (row >= 0) & (row < SIZE)
            face = np.where(inside, hit.numpy()[row.clip(0, SIZE - 1), col.clip(0, SIZE - 1)], -1)
            inside &= (face >= 0) & keep[face]
            corner = faces[face.clip(min=0)]
            mix = bary.numpy()[row.clip(0, SIZE - 1), col.clip(0, SIZE - 1)][..., None]
            place = (vertices[corner] * mix).sum(1)
            normal = (normals.numpy()[corner] * mix).sum(1)
            view = camera.position.numpy() - place
            length = np.linalg.norm(normal, axis=1) * np.linalg.norm(view, axis=1)
            cosine = (normal * view).sum(1) / np.maximum(length, 1e-12)
            w = np.where(inside & (cosine > MIN_COSINE), cosine**2, 0.0)
            total += w[:, None] * place
            weight += w
    if found < 3:
        raise RuntimeError(f"the detector found a face in only {found} renders of the mean head")
    ids = np.flatnonzero(weight > 0)
    place = total[ids] / weight[ids, None]
    return _snap(place, ids, vertices, faces, keep)


def _snap(
    place: np.ndarray, ids: np.ndarray, vertices: np.ndarray, faces: np.ndarray, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    import trimesh

    candidates = np.flatnonzero(keep)
    mesh = trimesh.Trimesh(vertices, faces[candidates], process=False)
    nearest, distance, triangle = trimesh.proximity.closest_point_naive(mesh, place)
    bary = trimesh.triangles.points_to_barycentric(mesh.triangles[triangle], nearest)
    print(f"  {len(ids)} landmarks, snapped by {distance.mean() * 1e3:.2f} mm (max {distance.max() * 1e3:.1f} mm)")
    weights = np.exp(-0.5 * (distance / 0.004) ** 2).clip(0.05, 1.0)
    return ids, candidates[triangle], bary.clip(0, 1), weights
