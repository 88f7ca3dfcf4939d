"""Carrying surface points and Gaussians along with the mesh (paper section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from uika.head.atlas import Binding
from uika.head.model import HeadModel
from uika.head.parameters import HeadParameters
from uika.head.posing import joint_transforms
from uika.head.rotations import quaternion_components

SMALL = 1e-18
FLAT = 1e-6  # twice the area over the longest edge squared, below which a triangle counts as flat
SCALE_RANGE = (0.5, 2.0)


def surface_points(vertices: Tensor, faces: Tensor, binding: Binding) -> Tensor:
    """Points [...,M,3] of a binding on a mesh [...,V,3] with triangles [F,3]."""
    return _interpolate(vertices, faces[binding.triangle], binding.barycentric)


def skin_points(points: Tensor, head: HeadModel, params: HeadParameters, binding: Binding) -> Tensor:
    """Animate free points as the authors' released model animates Gaussian centres.

    Expression offsets and skinning weights are mixed at each binding point and applied to `points`; there are no pose
    correctives, and the identity moves only the joints. Rotations and scales are left alone by that model.

    Args:
        points: [...,M,3] canonical points, metres.
        head: the head model.
        params: pose and expression, batch [...].
        binding: the M surface points that lend their weights.

    Returns:
        Posed points [...,M,3].
    """
    corners = head.faces[binding.triangle]
    weights = _interpolate(head.lbs_weights, corners, binding.barycentric)
    motion = (params.expression @ head.expression_basis.flatten(1)).unflatten(-1, (-1, 3))
    moved = points + _interpolate(motion, corners, binding.barycentric)
    blended = (weights @ joint_transforms(head, params)[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] * moved[..., None, :]).sum(-1) + blended[..., 3]


def surface_frames(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Right-handed triangle frames of a mesh [...,V,3] with triangles [F,3].

    Returns:
        Rotations [...,F,3,3] with columns tangent (first edge), bitangent and normal, and areas [...,F] in square
        metres. A triangle without area gets a frame that is still a rotation.
    """
    frame, area = _frames(*_edges(vertices, faces))
    return torch.stack(frame, -1).movedim(0, -2), area


def pose_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    canonical_vertices: Tensor,
    posed_vertices: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentric: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Move canonical Gaussians with the mesh they are bound to.

    A Gaussian keeps its offset from its surface point, turned by the surface's rotation; the rotation is averaged
    from triangles to vertices and interpolated, so that it has no jumps at triangle edges.

    Args:
        means: [M,3] canonical centres, metres.
        quats: [M,4] canonical rotations, wxyz.
        scales: [M,3] standard deviations, metres.
        canonical_vertices: [V,3] the mesh the Gaussians were placed on.
        posed_vertices: [...,V,3] the mesh in each frame.
        faces: [F,3] vertex ids.
        triangle: [M] triangle of each Gaussian.
        barycentric: [M,3] its surface point.

    Returns:
        Posed means [...,M,3], quats [...,M,4] and scales [...,M,3]; scales follow the square root of the surface's
        growth, limited to a factor between 0.5 and 2.
    """
    corners = faces.index_select(0, triangle)
    moved, turn, growth = _surface_motion(canonical_vertices, posed_vertices, faces, corners, barycentric)
    lead = (1,) * (moved.ndim - 2)
    offset = _components_first(means - _interpolate(canonical_vertices, corners, barycentric)).view(3, *lead, -1)
    own = _components_first(quats).view(4, *lead, -1)
    posed_means, posed_quats = moved + _turned(turn, offset), _product(turn, own)
    posed_scales = scales * growth[..., None]
    return posed_means.movedim(0, -1).contiguous(), posed_quats.movedim(0, -1).contiguous(), posed_scales


def unpose_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    canonical_vertices: Tensor,
    posed_vertices: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentric: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """The canonical Gaussians that `pose_gaussians` moves to the given ones; arguments as there, one frame.

    Args:
        means: [M,3] posed centres, metres.
        quats: [M,4] posed rotations, wxyz.
        scales: [M,3] posed standard deviations, metres.
        canonical_vertices: [V,3] the mesh at rest.
        posed_vertices: [V,3] the mesh that the Gaussians were placed on.
        faces: [F,3] vertex ids.
        triangle: [M] triangle of each Gaussian.
        barycentric: [M,3] its surface point.

    Returns:
        Canonical means [M,3], quats [M,4] and scales [M,3].
    """
    corners = faces.index_select(0, triangle)
    moved, turn, growth = _surface_motion(canonical_vertices, posed_vertices, faces, corners, barycentric)
    back = torch.cat((turn[:1], -turn[1:]))
    rest = _interpolate(canonical_vertices, corners, barycentric)
    canonical_means = rest + _turned(back, _components_first(means) - moved).mT
    canonical_quats = _product(back, _components_first(quats)).mT
    return canonical_means.contiguous(), canonical_quats.contiguous(), scales / growth[:, None]


def rigid_turn(canonical_vertices: Tensor, posed_vertices: Tensor) -> Tensor:
    """The rotation [...,4] (unit, wxyz) that best carries a mesh [V,3] to its posed self [...,V,3].

    Closed form of Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987.
    """
    rest, posed = (v.detach().double() for v in (canonical_vertices, posed_vertices))
    spread = (rest - rest.mean(-2, keepdim=True)).mT @ (posed - posed.mean(-2, keepdim=True))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in spread.unbind(-2))
    rows = (
        (xx + yy + zz, yz - zy, zx - xz, xy - yx),
        (yz - zy, xx - yy - zz, xy + yx, zx + xz),
        (zx - xz, xy + yx, yy - xx - zz, yz + zy),
        (xy - yx, zx + xz, yz + zy, zz - xx - yy),
    )
    matrix = torch.stack([torch.stack(row, -1) for row in rows], -2)
    return torch.linalg.eigh(matrix).eigenvectors[..., -1].to(posed_vertices.dtype)


def _surface_motion(
    canonical: Tensor, posed: Tensor, faces: Tensor, corners: Tensor, barycentric: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Places [3,...,M] of surface points on a posed mesh, their turns [4,...,M] (unit, wxyz) and growth [...,M]."""
    motion = torch.cat((posed, _vertex_motion(canonical, posed, faces)), -1)
    moved = _components_first(_interpolate(motion, corners, barycentric))
    turn = moved[3:7] * _dot(moved[3:7], moved[3:7]).clamp_min(SMALL).rsqrt()
    return moved[:3], turn, moved[7]


def _turned(turn: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [3,...] turned by unit quaternions [4,...]."""
    w, xyz = turn.split((1, 3))
    twice = 2 * _cross(xyz, vectors)
    return vectors + w * twice + _cross(xyz, twice)


def _product(one: Tensor, other: Tensor) -> Tensor:
    """The Hamilton product [4,...] of quaternions."""
    (w, xyz), (v, uvw) = one.split((1, 3)), other.split((1, 3))
    return torch.cat((w * v - _dot(xyz, uvw), w * uvw + v * xyz + _cross(xyz, uvw)))


def _interpolate(values: Tensor, corners: Tensor, barycentric: Tensor) -> Tensor:
    """Barycentric mix [...,M,C] of vertex values [...,V,C]."""
    # An embedding bag gathers and sums in one pass, several times faster than three gathers; frames ride as channels.
    table = values.movedim(-2, 0)
    weights = barycentric.to(values.dtype)
    mixed = embedding_bag(corners, table.reshape(len(table), -1), per_sample_weights=weights, mode="sum")
    return mixed.view(len(corners), *table.shape[1:]).movedim(0, -2)


def _vertex_motion(canonical: Tensor, posed: Tensor, faces: Tensor) -> Tensor:
    """Rotation (wxyz) and scale [...,V,5] that carry the canonical surface to the posed one at each vertex."""
    moved = _edges(posed, faces)
    first, second = (edge.view(3, *(1,) * (posed.ndim - 2), -1) for edge in _edges(canonical, faces))
    rest = (first, second)
    (tangent, bitangent, normal), area = _frames(*rest)
    (posed_tangent, posed_bitangent, posed_normal), posed_area = _frames(*moved)
    cosine, sine = _in_plane_twist(rest, tangent, bitangent, moved, posed_tangent, posed_bitangent)
    turned_tangent = cosine * posed_tangent + sine * posed_bitangent
    turned_bitangent = cosine * posed_bitangent - sine * posed_tangent
    pairs = ((turned_tangent, tangent), (turned_bitangent, bitangent), (posed_normal, normal))
    quats = _unit(quaternion_components(sum(after[:, None] * before[None] for after, before in pairs))) * area  # type: ignore[arg-type]
    # A quaternion and its negative are one rotation; before sums, all lie on the side of the whole mesh's rotation.
    with torch.no_grad():
        towards = rigid_turn(canonical, posed)
        sign = torch.where(_dot(quats, towards.movedim(-1, 0)[..., None]) < 0, -1.0, 1.0)
    parts = torch.cat((quats * sign, posed_area[None], area.expand_as(posed_area)[None])).movedim(-1, 0).contiguous()
    total = parts.new_zeros(canonical.shape[-2], *parts.shape[1:])
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], parts)
    total = total.movedim(0, -1)
    rotation = total[:4] * _dot(total[:4], total[:4]).clamp_min(SMALL).rsqrt()
    # The floors keep a vertex without triangles still, and the square root's gradient finite.
    growth = ((total[4] + SMALL) / (total[5] + SMALL)).sqrt().clamp(*SCALE_RANGE)
    return torch.cat((rotation, growth[None])).movedim(0, -1)


def _edges(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """First and second edge [3,...,F] of each triangle, from its first corner; components first for speed."""
    a, b, c = (vertices.movedim(-1, 0).index_select(-1, faces[:, corner]) for corner in range(3))
    return b - a, c - a


def _frames(first: Tensor, second: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Tangent, bitangent and normal [3,...,F] and area [...,F] from two edges."""
    cross = _cross(first, second)
    twice_area = _dot(cross, cross).clamp_min(SMALL**2).sqrt()
    longest = torch.maximum(_dot(first, first), _dot(second, second))
    sound = (twice_area > FLAT * longest) & (twice_area > SMALL)
    axes = torch.eye(3, dtype=first.dtype, device=first.device).view(3, 3, *(1,) * (first.ndim - 1))
    tangent = _unit(torch.where(sound, first, axes[0]))
    normal = _unit(torch.where(sound, cross, axes[2]))
    # Slivers lose the normal's digits: what is left of the tangent in it is taken out.
    normal = _unit(normal - _dot(normal, tangent) * tangent)
    return (tangent, _cross(normal, tangent), normal), twice_area / 2


def _in_plane_twist(
    rest: tuple[Tensor, Tensor],
    tangent: Tensor,
    bitangent: Tensor,
    moved: tuple[Tensor, Tensor],
    posed_tangent: Tensor,
    posed_bitangent: Tensor,
) -> tuple[Tensor, Tensor]:
    """Cosine and sine [...,F] of the turn about the normal that the first edges alone do not show.

    The frames follow the first edge; the polar part of the in-plane deformation says how far that edge's turn lies
    from the triangle's mean turn, so that the result does not depend on the order of the corners.
    """
    length, x, y = _dot(rest[0], tangent), _dot(rest[1], tangent), _dot(rest[1], bitangent)
    sound = (length.abs() > SMALL) & (y.abs() > SMALL)
    safe_y = torch.where(sound, y, 1.0)
    stretch = _dot(moved[0], posed_tangent) / torch.where(sound, length, 1.0)
    shear = (_dot(moved[1], posed_tangent) - stretch * x) / safe_y
    along = torch.where(sound, stretch + _dot(moved[1], posed_bitangent) / safe_y, 1.0)
    across = torch.where(sound, -shear, 0.0)
    scale = (along.square() + across.square() + SMALL).rsqrt()
    return along * scale, across * scale


def _components_first(points: Tensor) -> Tensor:
    return points.movedim(-1, 0).contiguous()


def _dot(one: Tensor, other: Tensor) -> Tensor:
    return (one * other).sum(0)


def _unit(vectors: Tensor) -> Tensor:
    return vectors * _dot(vectors, vectors).clamp_min(SMALL**2).rsqrt()


def _cross(one: Tensor, other: Tensor) -> Tensor:
    a, b, c = one.unbind(0)
    d, e, f = other.unbind(0)
    return torch.stack((b * f - c * e, c * d - a * f, a * e - b * d))
