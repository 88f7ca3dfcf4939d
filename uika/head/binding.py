"""Carrying surface points and Gaussians along with the mesh (paper section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, normalize

from uika.head.atlas import Binding
from uika.head.model import HeadModel
from uika.head.parameters import HeadParameters
from uika.head.posing import joint_transforms

_SMALL = 1e-20
_FLAT = 1e-6  # twice the area over the longest edge squared, below which a triangle counts as flat
_SCALE_RANGE = (0.5, 2.0)


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
    a, b, c = (vertices.index_select(-2, faces[:, corner]) for corner in range(3))
    cross = torch.linalg.cross(b - a, c - a)
    twice_area = cross.norm(dim=-1)
    x_axis, z_axis = (vertices.new_tensor(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    longest = torch.maximum((b - a).square().sum(-1), (c - a).square().sum(-1))
    sound = ((twice_area > _FLAT * longest) & (twice_area > _SMALL))[..., None]
    tangent = normalize(torch.where(sound, b - a, x_axis), dim=-1, eps=_SMALL)
    normal = torch.where(sound, cross, z_axis)
    # Slivers lose the normal's digits: what is left of the tangent in it is taken out.
    normal = normalize(normal, dim=-1, eps=_SMALL)
    normal = normalize(normal - (normal * tangent).sum(-1, keepdim=True) * tangent, dim=-1)
    return torch.stack((tangent, torch.linalg.cross(normal, tangent), normal), -1), twice_area / 2


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
    corners = faces[triangle]
    rotation, growth = _vertex_motion(canonical_vertices, posed_vertices, faces)
    offset = means - _interpolate(canonical_vertices, corners, barycentric)
    motion = _interpolate(torch.cat((posed_vertices, rotation, growth[..., None]), -1), corners, barycentric)
    turn = normalize(motion[..., 3:7], dim=-1)
    posed_means = motion[..., :3] + _rotate(turn, offset)
    return posed_means, _multiply(turn, quats), scales * motion[..., 7:8]


def _interpolate(values: Tensor, corners: Tensor, barycentric: Tensor) -> Tensor:
    """Barycentric mix [...,M,C] of vertex values [...,V,C]."""
    # An embedding bag gathers and sums in one pass, several times faster than three gathers; frames ride as channels.
    table = values.movedim(-2, 0)
    mixed = embedding_bag(corners, table.reshape(len(table), -1), per_sample_weights=barycentric, mode="sum")
    return mixed.view(-1, *table.shape[1:]).movedim(0, -2).contiguous()


def _vertex_motion(canonical: Tensor, posed: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation [...,V,4] (wxyz) and scale [...,V] that carry the canonical surface to the posed one at each vertex."""
    frames, area = surface_frames(canonical, faces)
    posed_frames, posed_area = surface_frames(posed, faces)
    twist = _in_plane_twist(canonical, posed, frames, posed_frames, faces)
    quats = _matrix_to_quaternion(posed_frames @ twist @ frames.mT) * area[..., None]
    # A quaternion and its negative are one rotation: before adding, all are turned to the mesh's mean rotation,
    # the main eigenvector of the summed outer products (Markley et al., Averaging Quaternions, 2007).
    with torch.no_grad():
        moment = (quats.mT @ quats).double()
        mean = torch.linalg.eigh(moment).eigenvectors[..., -1].to(quats.dtype)
        sign = torch.where((quats * mean[..., None, :]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    V = canonical.shape[-2]
    parts = torch.cat((quats * sign, posed_area[..., None], area.expand_as(posed_area)[..., None]), -1)
    total = parts.new_zeros(*parts.shape[:-2], V, 6)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], parts)
    rotation = normalize(total[..., :4], dim=-1, eps=_SMALL)
    # The floors keep a vertex without triangles still, and the square root's gradient finite.
    growth = ((total[..., 4] + _SMALL) / (total[..., 5] + _SMALL)).sqrt().clamp(*_SCALE_RANGE)
    return rotation, growth


def _in_plane_twist(canonical: Tensor, posed: Tensor, frames: Tensor, posed_frames: Tensor, faces: Tensor) -> Tensor:
    """Rotation [...,F,3,3] about the normal that makes the triangle's turn independent of the order of its corners.

    The frames follow the first edge; the polar part of the in-plane deformation says how far that edge's turn lies
    from the triangle's mean turn.
    """

    def flat(vertices: Tensor, frame: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, b, c = (vertices.index_select(-2, faces[:, corner]) for corner in range(3))
        tangent, bitangent = frame[..., 0], frame[..., 1]
        return ((b - a) * tangent).sum(-1), ((c - a) * tangent).sum(-1), ((c - a) * bitangent).sum(-1)

    length, x, y = flat(canonical, frames)
    posed_length, posed_x, posed_y = flat(posed, posed_frames)
    sound = (length.abs() > _SMALL) & (y.abs() > _SMALL)
    stretch = posed_length / torch.where(sound, length, 1.0)
    safe_y = torch.where(sound, y, 1.0)
    shear = (posed_x - stretch * x) / safe_y
    along = torch.where(sound, stretch + posed_y / safe_y, 1.0)
    across = torch.where(sound, -shear, 0.0)
    norm = (along.square() + across.square() + _SMALL).sqrt()
    cosine, sine = along / norm, across / norm
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    return torch.stack((cosine, -sine, zero, sine, cosine, zero, zero, zero, one), -1).unflatten(-1, (3, 3))


def _matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Unit quaternions [...,4] (wxyz, any sign) of rotations [...,3,3]."""
    xx, yy, zz = matrix.diagonal(dim1=-2, dim2=-1).unbind(-1)
    rows = torch.stack(
        (
            torch.stack((1 + xx + yy + zz, _skew(matrix, 2, 1), _skew(matrix, 0, 2), _skew(matrix, 1, 0)), -1),
            torch.stack((_skew(matrix, 2, 1), 1 + xx - yy - zz, _even(matrix, 0, 1), _even(matrix, 0, 2)), -1),
            torch.stack((_skew(matrix, 0, 2), _even(matrix, 0, 1), 1 - xx + yy - zz, _even(matrix, 1, 2)), -1),
            torch.stack((_skew(matrix, 1, 0), _even(matrix, 0, 2), _even(matrix, 1, 2), 1 - xx - yy + zz), -1),
        ),
        -2,
    )
    # Each row is the quaternion times four times one of its entries; the largest entry gives the exactest row.
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return normalize(chosen, dim=-1)


def _skew(matrix: Tensor, row: int, column: int) -> Tensor:
    return matrix[..., row, column] - matrix[..., column, row]


def _even(matrix: Tensor, row: int, column: int) -> Tensor:
    return matrix[..., row, column] + matrix[..., column, row]


def _rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    vector = vector.expand_as(xyz)
    twice = 2 * torch.linalg.cross(xyz, vector)
    return vector + w * twice + torch.linalg.cross(xyz, twice)


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    w, xyz, v, uvw = left[..., :1], left[..., 1:], right[..., :1], right[..., 1:]
    real = w * v - (xyz * uvw).sum(-1, keepdim=True)
    return torch.cat((real, w * uvw + v * xyz + torch.linalg.cross(xyz, uvw.expand_as(xyz))), -1)
