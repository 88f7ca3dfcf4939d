import math

import pytest
import torch

from tests.head.test_posing import posed_parameters
from uika.head import (
    HeadModel,
    HeadParameters,
    pose_gaussians,
    pose_vertices,
    rodrigues,
    surface_frames,
    surface_points,
    unpose_gaussians,
    uv_texels,
)

Gaussians = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def gaussians_on(head: HeadModel, size: int = 40) -> tuple[Gaussians, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    binding = uv_texels(head, size)
    means = surface_points(head.template, head.faces, binding)
    means = means + 0.01 * torch.randn(means.shape, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(len(means), 4, generator=generator), dim=-1)
    return (means, quats, torch.full((len(means), 3), 0.002)), binding.triangle, binding.barycentric


def to_matrix(quats: torch.Tensor) -> torch.Tensor:
    w, xyz = quats[..., :1], quats[..., 1:]
    half = torch.atan2(xyz.norm(dim=-1, keepdim=True), w)
    return rodrigues(torch.nn.functional.normalize(xyz, dim=-1) * 2 * half)


def test_rest_pose_leaves_gaussians_alone(head: HeadModel) -> None:
    gaussians, triangle, barycentric = gaussians_on(head)
    posed = pose_gaussians(*gaussians, head.template, head.template, head.faces, triangle, barycentric)
    torch.testing.assert_close(posed[0], gaussians[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(to_matrix(posed[1]), to_matrix(gaussians[1]), atol=1e-4, rtol=0)
    torch.testing.assert_close(posed[2], gaussians[2])


@pytest.mark.parametrize("turn", [(0.0, math.pi, 0.0), (3.1, 0.2, -0.4), (0.5, -0.3, 2.0)])
def test_rigid_motion_moves_gaussians_rigidly(head: HeadModel, turn: tuple[float, float, float]) -> None:
    gaussians, triangle, barycentric = gaussians_on(head)
    rotation, shift = rodrigues(torch.tensor(turn)), torch.tensor([0.1, -0.2, 0.3])
    vertices = head.template @ rotation.T + shift
    means, quats, scales = pose_gaussians(*gaussians, head.template, vertices, head.faces, triangle, barycentric)
    torch.testing.assert_close(means, gaussians[0] @ rotation.T + shift, atol=1e-5, rtol=0)
    torch.testing.assert_close(to_matrix(quats), rotation @ to_matrix(gaussians[1]), atol=2e-4, rtol=0)
    torch.testing.assert_close(scales, gaussians[2], atol=1e-6, rtol=0)


def test_growth_scales_and_is_limited(head: HeadModel) -> None:
    gaussians, triangle, barycentric = gaussians_on(head)
    for factor, expected in ((1.5, 1.5), (5.0, 2.0), (0.1, 0.5)):
        posed = pose_gaussians(*gaussians, head.template, head.template * factor, head.faces, triangle, barycentric)
        torch.testing.assert_close(posed[2], gaussians[2] * expected)


def test_shear_turns_by_its_polar_part_whatever_the_corner_order() -> None:
    flat = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.8, 0.0]])
    deformation = torch.tensor([[1.2, 0.5, 0.0], [0.1, 0.9, 0.0], [0.0, 0.0, 1.0]])
    angle = math.atan2(0.1 - 0.5, 1.2 + 0.9)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        _, turned, _ = pose_gaussians(
            torch.zeros(1, 3), quats, torch.ones(1, 3), flat, flat @ deformation.T, torch.tensor([order]),
            torch.tensor([0]), torch.tensor([[0.2, 0.3, 0.5]]),
        )  # fmt: skip
        expected = torch.tensor([[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]])
        torch.testing.assert_close(turned * turned[:, :1].sign(), expected)


def test_frames_of_a_batch_agree_with_single_frames(head: HeadModel) -> None:
    gaussians, triangle, barycentric = gaussians_on(head)
    vertices = pose_vertices(head, posed_parameters(head, 3))
    together = pose_gaussians(*gaussians, head.template, vertices, head.faces, triangle, barycentric)
    alone = pose_gaussians(*gaussians, head.template, vertices[1], head.faces, triangle, barycentric)
    torch.testing.assert_close(together[0][1], alone[0])
    torch.testing.assert_close(to_matrix(together[1][1]), to_matrix(alone[1]), atol=1e-4, rtol=0)
    assert together[2].shape == (3, len(triangle), 3)


def test_rotation_has_no_jumps_across_edges(head: HeadModel) -> None:
    jaw = HeadParameters.zeros(head).replace(jaw=torch.tensor([0.4, 0.0, 0.0]))
    vertices = pose_vertices(head, jaw)
    edge = head.faces[100, :2]
    sharing = [f for f, face in enumerate(head.faces.tolist()) if set(edge.tolist()) <= set(face)]
    assert len(sharing) == 2
    middle = [torch.isin(head.faces[face], edge).float() / 2 for face in sharing]
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4)
    means = vertices.new_zeros(2, 3)
    _, turned, _ = pose_gaussians(
        means, quats, torch.ones(2, 3), head.template, vertices, head.faces, torch.tensor(sharing), torch.stack(middle)
    )
    torch.testing.assert_close(turned[0], turned[1])


def test_degenerate_triangles_give_rotations_and_finite_gradients(head: HeadModel) -> None:
    crushed = head.template.clone()
    crushed[head.faces[50]] = crushed[head.faces[50, 0]].clone()
    frames, area = surface_frames(crushed, head.faces)
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(len(head.faces)))
    assert float(area[50]) < 1e-15
    gaussians, triangle, barycentric = gaussians_on(head)
    crushed.requires_grad_()
    posed = pose_gaussians(*gaussians, head.template, crushed, head.faces, triangle, barycentric)
    sum(part.sum() for part in posed).backward()  # type: ignore[union-attr]
    assert crushed.grad is not None and bool(crushed.grad.isfinite().all())


def test_no_gaussians_and_double_meshes_are_accepted(head: HeadModel) -> None:
    gaussians, triangle, barycentric = gaussians_on(head)
    none = tuple(part[:0] for part in gaussians)
    posed = pose_gaussians(*none, head.template, head.template, head.faces, triangle[:0], barycentric[:0])
    assert [tuple(part.shape) for part in posed] == [(0, 3), (0, 4), (0, 3)]
    points = surface_points(head.template.double(), head.faces, uv_texels(head, 40))
    assert points.dtype == torch.float64


def test_gradients_with_respect_to_vertices_are_exact() -> None:
    generator = torch.Generator().manual_seed(4)
    flat = torch.randn(5, 3, dtype=torch.float64, generator=generator)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    means = torch.randn(4, 3, dtype=torch.float64, generator=generator)
    quats = torch.randn(4, 4, dtype=torch.float64, generator=generator)
    scales = torch.ones(4, 3, dtype=torch.float64)
    barycentric = torch.softmax(torch.randn(4, 3, dtype=torch.float64, generator=generator), -1)
    triangle = torch.tensor([0, 1, 2, 1])
    posed = (flat * 1.1 + 0.1 * torch.randn(5, 3, dtype=torch.float64, generator=generator)).requires_grad_()

    def moved(vertices: torch.Tensor, centres: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return pose_gaussians(centres, quats, scales, flat, vertices, faces, triangle, barycentric)

    assert torch.autograd.gradcheck(moved, (posed, means.requires_grad_()))


def test_unposed_gaussians_are_posed_back(head: HeadModel) -> None:
    generator = torch.Generator().manual_seed(3)
    triangle = torch.randint(0, len(head.faces), (200,), generator=generator)
    middle = torch.full((200, 3), 1 / 3)
    params = HeadParameters.zeros(head).replace(
        neck=torch.tensor([0.1, 0.6, -0.2]),
        jaw=torch.tensor([0.2, 0.0, 0.0]),
        translation=torch.tensor([0.1, 0.0, 0.3]),
    )
    rest, posed = pose_vertices(head, HeadParameters.zeros(head)), pose_vertices(head, params)
    means = posed[head.faces[triangle]].mean(1) + 0.03 * torch.randn(200, 3, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(200, 4, generator=generator), dim=-1)
    scales = torch.rand(200, 3, generator=generator) * 0.01
    places = rest, posed, head.faces, triangle, middle
    again = pose_gaussians(*unpose_gaussians(means, quats, scales, *places), *places)
    torch.testing.assert_close(again[0], means, atol=1e-6, rtol=0)
    torch.testing.assert_close(again[1], quats, atol=1e-5, rtol=0)
    torch.testing.assert_close(again[2], scales, atol=1e-7, rtol=1e-5)
