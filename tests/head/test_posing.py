import pytest
import torch

from tests.heads import released_parity
from tests.recorded import recorded
from uika.head import (
    HeadModel,
    HeadParameters,
    joint_transforms,
    pose_vertices,
    rodrigues,
    shaped_vertices,
    vertex_normals,
)


def posed_parameters(head: HeadModel, batch: int = 4) -> HeadParameters:
    generator = torch.Generator().manual_seed(1)

    def noise(size: int) -> torch.Tensor:
        return 0.3 * torch.randn(batch, size, generator=generator)

    K, E = len(head.identity_basis), len(head.expression_basis)
    return HeadParameters(noise(K), noise(E), noise(3), noise(3), noise(3), noise(6), noise(3))


def test_rodrigues_is_the_matrix_exponential() -> None:
    axis_angle = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).view(-1, 3, 3)
    torch.testing.assert_close(rodrigues(axis_angle), torch.linalg.matrix_exp(cross))


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5])
def test_rodrigues_has_its_gradient_at_zero(size: float) -> None:
    axis_angle = torch.tensor([size, 0.0, 0.0], requires_grad=True)
    (gradient,) = torch.autograd.grad(rodrigues(axis_angle)[2, 1], axis_angle)
    torch.testing.assert_close(gradient, torch.tensor([1.0, 0.0, 0.0]))


def test_rest_pose_is_the_shape(head: HeadModel) -> None:
    params = posed_parameters(head)
    zero = HeadParameters.zeros(head, 4)
    still = zero.replace(identity=params.identity, expression=params.expression)
    torch.testing.assert_close(pose_vertices(head, still), shaped_vertices(head, still))
    torch.testing.assert_close(pose_vertices(head, zero)[2], head.template)


def test_root_rotation_and_translation_are_rigid(head: HeadModel) -> None:
    params = HeadParameters.zeros(head, 1).replace(
        rotation=torch.tensor([[0.3, -0.8, 0.2]]), translation=torch.tensor([[0.1, 0.2, -0.3]])
    )
    rotation = rodrigues(params.rotation[0])
    root = head.joints[0]
    expected = (head.template - root) @ rotation.T + root + params.translation
    torch.testing.assert_close(pose_vertices(head, params)[0], expected)


def test_batch_agrees_with_single_and_broadcast(head: HeadModel) -> None:
    params = posed_parameters(head)
    together = pose_vertices(head, params)
    torch.testing.assert_close(together[2], pose_vertices(head, params[2]))
    one_identity = params.replace(identity=params.identity[0])
    torch.testing.assert_close(pose_vertices(head, one_identity)[0], together[0])
    assert HeadParameters.stack([params[0], params[1]]).batch_shape == (2,)


def test_posing_gradients_are_exact(head: HeadModel) -> None:
    double = head.to(torch.float64)
    params = posed_parameters(head, 1).to(torch.float64)

    def some_vertices(rotation: torch.Tensor, jaw: torch.Tensor, identity: torch.Tensor) -> torch.Tensor:
        return pose_vertices(double, params.replace(rotation=rotation, jaw=jaw, identity=identity))[:, ::40]

    inputs = [t.requires_grad_() for t in (torch.zeros(1, 3).double(), params.jaw.clone(), params.identity.clone())]
    assert torch.autograd.gradcheck(some_vertices, inputs)


def test_wrong_coefficient_count_is_named(head: HeadModel) -> None:
    params = HeadParameters.zeros(head).replace(identity=torch.zeros(7))
    with pytest.raises(ValueError, match="identity has 7 coefficients; this head has 4"):
        pose_vertices(head, params)
    with pytest.raises(ValueError, match=r"'eyes' has shape \(3,\); it must end in 6"):
        HeadParameters.zeros(head).replace(eyes=torch.zeros(3))


def test_vertex_normals_point_outwards(head: HeadModel) -> None:
    normals = vertex_normals(head.template, head.faces)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)))
    radial = torch.nn.functional.normalize(head.template / torch.tensor([0.08, 0.1, 0.09]) ** 2, dim=-1)
    assert float((normals * radial).sum(-1).min()) > 0.99


@recorded
def test_released_vertex_path() -> None:
    data, head = released_parity()
    params = HeadParameters(
        *(data[f"in/{name}"] for name in ("shape", "expr", "rotation", "neck", "jaw", "eyes", "translation"))
    )
    vertices = pose_vertices(head, params)
    torch.testing.assert_close(vertices, data["out/mesh_animated"], atol=1e-6, rtol=0)
    torch.testing.assert_close(head.landmarks(vertices), data["out/mesh_landmarks"], atol=1e-6, rtol=0)


@recorded
def test_released_joint_transforms() -> None:
    data, head = released_parity()
    names = ("expr", "rotation", "neck", "jaw", "eyes")
    params = HeadParameters(torch.zeros(3, 20), *(data[f"in/{name}"] for name in names), torch.zeros(3, 3))
    torch.testing.assert_close(joint_transforms(head, params), data["out/rel_transforms"], atol=1e-6, rtol=0)
