"""The kernels pose as the differentiable torch functions do."""

import pytest
import torch

from drjit_splat.profiling import profile
from tests.head.test_binding import gaussians_on
from tests.head.test_posing import posed_parameters
from tests.heads import sphere_head
from uika.avatar.rig import Rig
from uika.head import HeadModel, HeadParameters, load_head, pose_gaussians, pose_vertices
from uika.head.binding import rigid_turn
from uika.motion.presets import expression_vector


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return sphere_head()


def posed_both_ways(head: HeadModel, vertices: torch.Tensor, size: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    gaussians, triangle, barycentric = gaussians_on(head, size)
    rig = Rig.of(*gaussians, head.template, head.faces, triangle, barycentric)
    posed = rig.pose(vertices, rigid_turn(head.template, vertices))
    expected = pose_gaussians(*gaussians, head.template, vertices, head.faces, triangle, barycentric)
    return [(array.torch().view(wanted.shape), wanted) for array, wanted in zip(posed, expected, strict=True)]


@pytest.mark.parametrize("frame", [0, 1, 2])
def test_agrees_with_torch_on_a_posed_head(head: HeadModel, frame: int) -> None:
    vertices = pose_vertices(head, posed_parameters(head, 3))[frame]
    for found, expected in posed_both_ways(head, vertices, 40):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("actions", "turn"),
    [
        ({"jawOpen": 0.9}, (0.0, 0.9, 0.0)),
        ({"mouthPucker": 1.0, "eyeBlinkLeft": 1.0}, (0.1, 3.1, 0.2)),
        ({}, (0, 0, 0)),
    ],
)
def test_agrees_with_torch_on_the_built_in_head(actions: dict[str, float], turn: tuple[float, float, float]) -> None:
    head = load_head()
    params = HeadParameters.zeros(head).replace(
        rotation=torch.tensor(turn), expression=expression_vector(head, actions), neck=torch.tensor([0.1, -0.2, 0.1])
    )
    for found, expected in posed_both_ways(head, pose_vertices(head, params), 96):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_growth_is_limited_and_crushed_triangles_stay_finite(head: HeadModel) -> None:
    crushed = head.template * 5
    crushed[head.faces[50]] = crushed[head.faces[50, 0]].clone()
    pairs = posed_both_ways(head, crushed, 40)
    for found, _ in pairs:
        assert bool(found.isfinite().all())
    torch.testing.assert_close(pairs[2][0], pairs[2][1])
    assert float(pairs[2][0].max()) == pytest.approx(0.004)


def test_new_frames_compile_nothing(head: HeadModel) -> None:
    gaussians, triangle, barycentric = gaussians_on(head)
    rig = Rig.of(*gaussians, head.template, head.faces, triangle, barycentric)
    vertices = pose_vertices(head, posed_parameters(head, 3))
    turns = rigid_turn(head.template, vertices)
    rig.pose(vertices[0], turns[0])
    with profile() as report:
        for frame in (1, 2):
            rig.pose(vertices[frame], turns[frame])
    assert report.launched == 6 and report.compiled == 0


def test_rigid_turn_is_the_rotation(head: HeadModel) -> None:
    params = HeadParameters.zeros(head, 2).replace(rotation=torch.tensor([[0.0, 1.2, 0.0], [3.0, 0.0, 0.0]]))
    turns = rigid_turn(head.template, pose_vertices(head, params))
    half = torch.tensor([[0.0, 0.6, 0.0], [1.5, 0.0, 0.0]])
    expected = torch.cat((half.norm(dim=-1, keepdim=True).cos(), half.sign() * half.abs().sin()), -1)
    torch.testing.assert_close(turns * turns[:, :1].sign() * expected[:, :1].sign(), expected, atol=1e-5, rtol=0)
