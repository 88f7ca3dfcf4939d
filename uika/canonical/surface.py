"""The canonical head surface as the splats that close it, one for each texel of the atlas (paper section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from uika.canonical.regions import mask_at_texels, regions
from uika.head import (
    Binding,
    HeadModel,
    HeadParameters,
    shaped_vertices,
    surface_frames,
    surface_points,
    uv_texels,
    vertex_normals,
)
from uika.head.rotations import matrices_to_quaternions

FOOTPRINT = 0.7  # standard deviation over the distance of neighbouring texels: overlap without blur
SEAM = 1.4  # enlarges splats at the edge of a chart, whose neighbours beyond the seam are moved apart from them
FLATNESS = 0.1  # standard deviation along the normal over the mean tangential one
_SIZE_RANGE = (2e-5, 1e-2)  # metres, of a texel's side: keeps slivers of the atlas from vanishing or exploding
SINK = 0.5  # standard deviations below the surface: nearer splats cover those behind, which shows it too far out
_MIRROR_TOLERANCE = 3e-3  # metres between a mirrored vertex and the vertex it stands for


@dataclass(frozen=True)
class SurfaceTexels:
    """The canonical head surface at the M valid texels of the atlas; B is the batch size or 1.

    points  [B,M,3] metres
    quats   [B,M,4] wxyz rotation of the surface frame, local z along the outward normal
    scales  [B,M,3] metres: standard deviations that close the surface, two tangent sizes and a thin normal one
    mirror  [S,S] int64 row-major index of each texel's counterpart on the other half of the face, -1 where there is
            none; None if unknown
    regions [S,S] int64 labels of parts whose colours do not mix (skin, eyeballs, teeth), or None
    lift    [1,S,S] metres by which hair stands off the bald head, 0 elsewhere, or None
    shape   [3,S,S] metres from the mean bald head to the surface, 0 elsewhere, or None
    face    [1,S,S] how far each texel belongs to the face, in [0,1], 0 elsewhere, or None
    prior   [3,S,S] colours for texels that neither a photo nor its mirror image shows, NaN where there is none, or None
    """

    points: Tensor
    quats: Tensor
    scales: Tensor
    mirror: Tensor | None = None
    regions: Tensor | None = None
    prior: Tensor | None = None
    lift: Tensor | None = None
    shape: Tensor | None = None
    face: Tensor | None = None

    def rows(self, first: int, last: int) -> SurfaceTexels:
        """The texels from `first` to before `last`; the maps stay whole."""
        points, quats, scales = (value[:, first:last] for value in (self.points, self.quats, self.scales))
        return replace(self, points=points, quats=quats, scales=scales)


def surface_texels(
    head: HeadModel, identity: Tensor, static_offset: Tensor, size: int
) -> tuple[SurfaceTexels, Binding]:
    """Place a flat splat on the head surface at every covered texel of a `size` x `size` atlas; a bust gets none.

    Each splat follows its texel's footprint on the surface, stretched and turned as the atlas is there, so that
    neighbours overlap wherever the atlas is uneven. Centres lie a little below the surface, so that a picture of the
    splats shows colours and outline where the surface has them.

    Args:
        head: the head model.
        identity: [K] standard deviations.
        static_offset: [V,3] metres.
        size: side of the atlas in texels.

    Returns:
        The surface with batch dimension 1, with its mirror map and regions, and the binding of its M texels.
    """
    head = head.without_bust
    static_offset = static_offset[: len(head.template)]
    binding = uv_texels(head, size)
    neutral = HeadParameters.zeros(head).replace(identity=identity)
    vertices = shaped_vertices(head, neutral, static_offset)
    points, quats, scales = closing_splats(head, vertices, binding)
    surface = SurfaceTexels(points[None], quats[None], scales[None], mirror_map(head, size), regions(head, binding))
    deviation = (vertices - head.template)[head.faces[binding.triangle]] * binding.barycentric[..., None]
    shape = binding.to_map(deviation.sum(1))
    lift = _lift(head, neutral, static_offset, binding)
    return replace(surface, lift=lift, shape=shape, face=face_map(head, binding)), binding


def face_map(head: HeadModel, binding: Binding) -> Tensor | None:
    """How far each texel belongs to the face [1,S,S], 0 outside the atlas; None for a head that does not know."""
    if "face" not in head.masks:
        return None
    return binding.to_map(mask_at_texels(head, binding, "face")[:, None])


def template_texels(head: HeadModel, size: int) -> tuple[SurfaceTexels, Binding]:
    """Points on the mean head at every texel strictly inside the atlas, where the paper's Gaussians start.

    Rotations and sizes are absolute in a model on the template and ask nothing of the surface.

    Returns:
        The surface with batch dimension 1, and the binding of its M texels.
    """
    binding = uv_texels(head, size, "released")
    points = surface_points(head.template, head.faces, binding)
    upright = torch.eye(4)[:1].expand(len(points), -1)
    return SurfaceTexels(points[None], upright[None], torch.ones_like(points)[None]), binding


def canonical_binding(head: HeadModel, canonical: str, size: int) -> Binding:
    """The texels of a model with this `ModelConfig.canonical`."""
    return uv_texels(head, size, "released" if canonical == "template" else "watertight")


def closing_splats(head: HeadModel, vertices: Tensor, binding: Binding) -> tuple[Tensor, Tensor, Tensor]:
    """Centres [M,3], rotations [M,4] and sizes [M,3] of flat splats at texels that close a mesh [V,3]."""
    points = surface_points(vertices, head.faces, binding)
    frames, sides = _texel_frames(head, vertices, binding, points)
    sides = torch.where(_at_seam(binding)[:, None], SEAM * sides, sides)
    scales = torch.cat((FOOTPRINT * sides, FLATNESS * FOOTPRINT * sides.mean(-1, keepdim=True)), -1)
    points = points - SINK * scales[:, :2].mean(-1, keepdim=True) * frames[..., 2]
    return points, matrices_to_quaternions(frames), scales


def _at_seam(binding: Binding) -> Tensor:
    """Which of the M texels have a neighbour outside the atlas."""
    outside = (~binding.valid).float()[None, None]
    return binding.from_map(torch.nn.functional.max_pool2d(outside, 3, 1, 1)[0])[:, 0] > 0


def _lift(head: HeadModel, neutral: HeadParameters, static_offset: Tensor, binding: Binding) -> Tensor:
    """How far [1,S,S] in metres the surface stands off the bald head along its normals."""
    bald = shaped_vertices(head, neutral)
    normals = torch.nn.functional.normalize(vertex_normals(bald, head.faces), dim=-1)
    height = (static_offset * normals).sum(-1)[head.faces[binding.triangle]]
    return binding.to_map((height * binding.barycentric).sum(-1, keepdim=True))


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


def _texel_frames(head: HeadModel, vertices: Tensor, binding: Binding, points: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations [M,3,3] along the principal axes of each texel's footprint, and its two sides [M,2] in metres.

    Steps to the neighbouring texels follow the surface where the atlas is coarser than its relief (ears); the
    triangle's own derivative stands in where a texel has no neighbours.
    """
    frames, _ = surface_frames(vertices, head.faces)
    corners, uvs = vertices[head.faces], head.uvs[head.uv_faces]
    edges = (corners[:, 1:] - corners[:, :1]).mT  # [F,3,2]
    texels = (uvs[:, 1:] - uvs[:, :1]).mT * uvs.new_tensor([[1.0], [-1.0]]) * binding.size
    sound = torch.linalg.det(texels).abs() > 1e-9
    slopes = edges @ torch.linalg.inv(torch.where(sound[:, None, None], texels, torch.eye(2)))
    slope = slopes[binding.triangle]
    place = binding.to_map(points, fill=torch.nan)
    across = _step(place, binding, 2, slope[..., 0])
    down = _step(place, binding, 1, slope[..., 1])
    angle = 0.5 * torch.atan2(2 * (across * down).sum(-1), (across**2 - down**2).sum(-1))[:, None]
    first = torch.cos(angle) * across + torch.sin(angle) * down
    second = torch.cos(angle) * down - torch.sin(angle) * across
    sides = torch.stack((first.norm(dim=-1), second.norm(dim=-1)), -1)
    normal = frames[binding.triangle][..., 2]
    tangent = _unit(torch.where(sides[:, :1] > 1e-9, first, frames[binding.triangle][..., 0]))
    outward = torch.linalg.cross(first, second)
    upright = (outward * normal).sum(-1, keepdim=True)
    # Where the steps span no plane, or fold over, the triangle's normal is the better one.
    outward = torch.where(upright.abs() > 0.2 * outward.norm(dim=-1, keepdim=True), outward * upright.sign(), normal)
    outward = _unit(outward - (outward * tangent).sum(-1, keepdim=True) * tangent)
    return torch.stack((tangent, torch.linalg.cross(outward, tangent), outward), -1), sides.clamp(*_SIZE_RANGE)


def _step(place: Tensor, binding: Binding, axis: int, slope: Tensor) -> Tensor:
    """Mean step [M,3] from a texel to its neighbours along an axis of the map [3,S,S]; `slope` where it has none."""
    forward = torch.full_like(place, torch.nan)
    size = place.shape[axis]
    forward.narrow(axis, 0, size - 1).copy_(place.diff(dim=axis))
    backward = forward.roll(1, axis)
    step = binding.from_map(torch.nanmean(torch.stack((forward, backward)), 0))
    return torch.where(torch.isfinite(step), step, slope)


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-20)
