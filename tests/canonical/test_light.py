"""Light told apart from skin on a made-up head."""

import pytest
import torch
from torch import Tensor

from uika.canonical.light import (
    absolute_light,
    joined,
    relative_lights,
    remembered,
    sample_light,
    under_reference,
)
from uika.head import HeadModel, load_head, look_at, project, rasterize, vertex_normals
from uika.head.light import COUNT, from_environment, harmonics, received, to_linear, to_srgb

SIZE = 160
YAWS = (0.0, 20.0, -20.0)


def light(strength: float, *directions: float) -> Tensor:
    """White light: a mean of `strength`, and slopes along x, y and z over it."""
    result = torch.zeros(COUNT, 3)
    result[0] = strength / harmonics(torch.tensor([0.0, 0.0, 1.0]))[0]
    for axis, slope in zip((3, 1, 2), directions, strict=True):
        result[axis] = strength * slope / harmonics(torch.eye(3))[axis % 3, axis]
    return result


LIGHTS = (light(1.0, 0.3, 0.1, 0.1), light(0.6, -0.3, 0.1, 0.0), light(1.1, 0.0, -0.2, 0.1))


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def photos(head: HeadModel, lights: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Pictures [N,3,S,S], places in the atlas [N,2,S,S] and weights [N,1,S,S] of a head with blotchy skin."""
    normals = vertex_normals(head.template, head.faces)
    blotches = 1 + 0.2 * torch.sin(90 * head.template).prod(-1, keepdim=True)
    skin = torch.tensor([0.45, 0.28, 0.2]) * blotches
    corner_uv = head.uvs[head.uv_faces] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    images, places, weights = [], [], []
    for yaw, lit in zip(YAWS, lights, strict=False):
        camera = look_at(yaw, 0.0, 0.8, fov_y=20.0, size=SIZE)
        points, depth = project(head.template, camera)
        triangle, mix = rasterize(points, head.faces, SIZE, SIZE, depth=depth, cull="back")
        hit, at = triangle >= 0, triangle.clamp(min=0)
        colors = skin * received(lit, normals)
        picture = (colors[head.faces[at]] * mix[..., None]).sum(-2)
        place = (corner_uv[at] * mix[..., None]).sum(-2)
        images.append(to_srgb(torch.where(hit[..., None], picture, 0.5)).permute(2, 0, 1))
        places.append(torch.where(hit[..., None], place, torch.nan).permute(2, 0, 1))
        weights.append(hit[None].float())
    return torch.stack(images), torch.stack(places), torch.stack(weights)


def test_photos_come_under_one_light(head: HeadModel) -> None:
    none = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    images, uv, weight = photos(head, LIGHTS)
    same, _, _ = photos(head, (LIGHTS[0],) * 3)
    sample = sample_light(head, *none, images, uv, weight)
    lights = relative_lights(sample, 0)
    assert lights[0].abs().max() == 0
    result = under_reference(images, uv, sample, lights)
    face = sample_light(head, *none, same, uv, weight).weight
    for n in (1, 2):
        found = sample_light(head, *none, result, uv, weight).color[n][face[n] > 0]
        true = sample_light(head, *none, same, uv, weight).color[n][face[n] > 0]
        before = sample.color[n][face[n] > 0]
        assert (found - true).abs().mean() < 0.35 * (before - true).abs().mean()
    assert torch.equal(result[0], images[0])
    assert torch.equal(result[:, :, 0, 0], images[:, :, 0, 0])  # off the head nothing changes


def test_a_photo_added_later_comes_under_the_same_light(head: HeadModel) -> None:
    none = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    images, uv, weight = photos(head, LIGHTS)
    whole = sample_light(head, *none, images, uv, weight)
    first = whole._replace(color=whole.color[:2], weight=whole.weight[:2])
    memory = remembered(first, relative_lights(first, 0))
    both = joined(memory, whole._replace(color=whole.color[2:], weight=whole.weight[2:]))
    later = relative_lights(both, 0)[1]
    together = relative_lights(whole, 0)[2]
    assert ((whole.basis @ (later - together))[whole.weight[2] > 0]).abs().mean() < 0.06


def test_the_common_light_is_the_mean_by_the_photos_shares(head: HeadModel) -> None:
    none = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    sample = sample_light(head, *none, *photos(head, LIGHTS))
    apart, share = relative_lights(sample, 0), torch.tensor([2.0, 1.0, 1.0])
    common = relative_lights(sample, 0, share)
    assert (common * share[:, None, None]).sum(0).abs().max() < 1e-5
    torch.testing.assert_close(common - common[:1], apart, atol=1e-5, rtol=0)


def test_one_photo_tells_its_light_when_skin_is_alike(head: HeadModel) -> None:
    none = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    images, uv, weight = photos(head, LIGHTS[:1])
    sample = sample_light(head, *none, images, uv, weight)
    assert relative_lights(sample, 0).abs().max() == 0
    found = absolute_light(sample, torch.zeros(1, COUNT, 3), 0)
    seen = sample.weight[0] > 0
    shade, true = (sample.basis[seen] @ each for each in (found, LIGHTS[0]))
    shade, true = shade / shade.mean(0), true / true.mean(0)
    assert (shade - true).abs().mean() < 0.3 * (true - 1).abs().mean()


def test_an_even_room_lights_evenly_and_a_lamp_from_its_side() -> None:
    room = from_environment(torch.full((32, 64, 3), 0.7))
    torch.testing.assert_close(received(room, torch.eye(3)), torch.full((3, 3), 0.7), atol=0.01, rtol=0)
    lamp = torch.zeros(32, 64, 3)
    lamp[12:20, 12:20] = 30.0  # left of the middle: towards +X
    amount = received(from_environment(lamp), torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]]))
    assert (amount[0] > 3 * amount[1]).all()


def test_srgb_and_linear_are_inverse() -> None:
    levels = torch.linspace(0, 1, 101)
    torch.testing.assert_close(to_srgb(to_linear(levels)), levels, atol=2e-4, rtol=0)
