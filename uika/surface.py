"""The canonical head surface as the splats that close it, one for each texel of the atlas (paper section 3.3)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from uika.head import Binding, HeadModel, HeadParameters, shaped_vertices, surface_frames, surface_points, uv_texels
from uika.model import SurfaceTexels

FOOTPRINT = 0.7  # standard deviation over the distance of neighbouring texels: overlap without blur
FLATNESS = 0.1  # standard deviation along the normal over the mean tangential one
_SIZE_RANGE = (2e-5, 1e-2)  # metres, of a texel's side: keeps slivers of the atlas from vanishing or exploding
# Where the atlas is coarser than the relief under it (ears), full-size splats would stick out like feathers.
_RELIEF = 3.2e-3  # metres on the template
_MIRROR_TOLERANCE = 3e-3  # metres between a mirrored vertex and the vertex it stands for


def surface_texels(
    head: HeadModel, identity: Tensor, static_offset: Tensor, size: int
) -> tuple[SurfaceTexels, Binding]:
    """Place a flat splat on the head surface at every covered texel of a `size` x `size` atlas.

    Each splat follows its texel's footprint on the surface, stretched and turned as the atlas is there, so that
    neighbours overlap wherever the atlas is uneven.

    Args:
        head: the head model.
        identity: [K] standard deviations.
        static_offset: [V,3] metres.
        size: side of the atlas in texels.

    Returns:
        The surface with batch dimension 1 and its mirror map, and the binding of its M texels.
    """
    binding = uv_texels(head, size)
    neutral = HeadParameters.zeros(head).replace(identity=identity)
    vertices = shaped_vertices(head, neutral, static_offset)
    frames, sides = _texel_frames(head, vertices, size)
    _, plain = _texel_frames(head, head.template, size)
    sides = sides * (_RELIEF / plain.amax(-1, keepdim=True)).clamp_max(1)
    quats = _quaternions(frames)[binding.triangle]
    sides = sides[binding.triangle]
    scales = torch.cat((FOOTPRINT * sides, FLATNESS * FOOTPRINT * sides.mean(-1, keepdim=True)), -1)
    points = surface_points(vertices, head.faces, binding)
    return SurfaceTexels(points[None], quats[None], scales[None], mirror_map(head, size)), binding


@lru_cache(maxsize=4)
def mirror_map(head: HeadModel, size: int) -> Tensor:
    """Row-major index [S,S] of the texel at the mirrored place on the other half of the head; -1 where none is known.

    The head's template decides, whatever the person's face: vertices are paired across the plane x = 0.
    """
    binding = uv_texels(head, size)
    corners = _mirrored_corners(head)[binding.triangle]  # [M,3,2]
    uv = (corners * binding.barycentric[..., None]).sum(1)
    cell = (torch.stack((uv[:, 0], 1 - uv[:, 1]), -1) * size).floor().nan_to_num(-1).long()
    index = cell[:, 1] * size + cell[:, 0]
    inside = ((cell >= 0) & (cell < size)).all(-1)
    usable = inside & binding.valid.flatten()[torch.where(inside, index, 0)]
    result = torch.full((size * size,), -1)
    result[binding.texel[usable]] = index[usable]
    return result.view(size, size)


def _mirrored_corners(head: HeadModel) -> Tensor:
    """UVs [F,3,2] (v up) of the mirrored corners of each triangle, NaN where there is no counterpart."""
    flipped = head.template * head.template.new_tensor([-1.0, 1.0, 1.0])
    distance, partner = torch.cdist(flipped, head.template).min(1)
    unused = torch.full((len(head.template), 2), torch.nan, dtype=head.uvs.dtype)
    vertex_uv = unused.clone()
    vertex_uv[head.faces.flatten()] = head.uvs[head.uv_faces.flatten()]
    # A vertex on a seam has several UVs: only the mirrored triangle itself can say which of them is meant.
    seam = (vertex_uv[head.faces] != head.uvs[head.uv_faces]).any(-1)
    vertex_uv[head.faces[seam]] = torch.nan
    mirrored = partner[head.faces]
    result = vertex_uv[mirrored]
    order = mirrored.argsort(1)
    place = {tuple(face): row for row, face in enumerate(head.faces.sort(1).values.tolist())}
    rows = torch.tensor([place.get(tuple(face), -1) for face in mirrored.gather(1, order).tolist()])
    found = rows >= 0
    theirs = head.faces[rows[found]].argsort(1)
    uvs = head.uvs[head.uv_faces[rows[found]].gather(1, theirs)]
    matched = torch.empty_like(uvs).scatter(1, order[found][..., None].expand(-1, -1, 2), uvs)
    result[found] = matched
    result[(distance[head.faces] > _MIRROR_TOLERANCE).any(-1)] = torch.nan
    return result


def _texel_frames(head: HeadModel, vertices: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Rotations [F,3,3] along the principal axes of a texel's footprint, and its two sides [F,2] in metres."""
    frames, _ = surface_frames(vertices, head.faces)
    corners, uvs = vertices[head.faces], head.uvs[head.uv_faces]
    edges = frames[..., :2].mT @ (corners[:, 1:] - corners[:, :1]).mT  # [F,2,2], in the plane of the triangle
    steps = (uvs[:, 1:] - uvs[:, :1]).mT * size
    determinant = torch.linalg.det(steps)
    sound = determinant.abs() > 1e-9
    inverse = torch.linalg.inv(torch.where(sound[:, None, None], steps, torch.eye(2)))
    axes, sides, _ = torch.linalg.svd(edges @ inverse)
    first = (frames[..., :2] @ axes[..., :1])[..., 0]
    normal = frames[..., 2]
    turned = torch.stack((first, torch.linalg.cross(normal, first), normal), -1)
    return turned, sides.clamp(*_SIZE_RANGE)


def _quaternions(rotation: Tensor) -> Tensor:
    """Unit quaternions [...,4] (wxyz) of rotation matrices [...,3,3]."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    rows = torch.stack(
        (
            torch.stack((1 + xx + yy + zz, zy - yz, xz - zx, yx - xy), -1),
            torch.stack((zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx), -1),
            torch.stack((xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy), -1),
            torch.stack((yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz), -1),
        ),
        -2,
    )
    # Every row is the quaternion times four times one of its entries; the row of the largest entry is the exactest.
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return torch.nn.functional.normalize(chosen, dim=-1)
