"""A torso's turn, shape and clothes found again from the outline of a person who was made from them."""

import numpy as np
import pytest
import torch

from uika.fitting.outline_rays import directions, far_crossings, first_exits
from uika.fitting.torso import fit_torso, torso_parameters
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at, pose_vertices, project, rasterize

SIZE = 192


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def matte(head: HeadModel, params: HeadParameters, offset: torch.Tensor, camera: Camera) -> torch.Tensor:
    points, depth = project(pose_vertices(head, params, offset), camera)
    triangle, _ = rasterize(points, head.faces, camera.height, camera.width, depth=depth, cull="none")
    return (triangle >= 0).float()


def test_a_turned_torso_leaves_the_head_in_place(head: HeadModel) -> None:
    params = HeadParameters.zeros(head).replace(identity=torch.randn(100, generator=torch.Generator().manual_seed(0)))
    turned = torso_parameters(head, params, torch.tensor([0.2, -0.4, 0.1]))
    before, after = pose_vertices(head, params), pose_vertices(head, turned)
    held = head.lbs_weights[:, 0] == 0
    torch.testing.assert_close(after[held], before[held], atol=1e-5, rtol=0)
    assert float((after - before)[head.masks["torso"] > 0].norm(dim=-1).max()) > 0.05


def test_turn_and_width_are_read_from_the_outline(head: HeadModel) -> None:
    assert head.bust is not None
    camera = look_at(0.0, 0.0, 1.3, target=(0.0, -0.12, 0.0), fov_y=26.0, size=SIZE)
    params = HeadParameters.zeros(head, 1)
    offset = torch.zeros_like(head.template)
    offset[head.bust.vertex :] = 1.5 * head.bust.modes[0] - head.bust.modes[1]
    turn = torch.tensor([[0.0, 0.0, 0.16]])
    shown = matte(head, torso_parameters(head, params[0], turn[0]), offset, camera)[None]
    cameras = Camera.stack([camera])
    found = fit_torso(head, params, torch.zeros(head.bust.vertex, 3), cameras, shown, torch.ones_like(shown))
    assert abs(float(found.turns[0, 2] - turn[0, 2])) < 0.08
    again = matte(head, torso_parameters(head, params[0], found.turns[0]), found.offset, camera)
    plain = matte(head, params[0], torch.zeros_like(head.template), camera)

    def overlap(one: torch.Tensor) -> float:
        both = (one > 0) & (shown[0] > 0)
        return float(both.sum() / ((one > 0) | (shown[0] > 0)).sum())

    assert overlap(again) > 0.96, overlap(plain)
    assert overlap(plain) < 0.94
    assert float(found.offset[: head.bust.vertex].abs().max()) == 0


def test_nothing_known_leaves_the_mean_torso(head: HeadModel) -> None:
    assert head.bust is not None
    camera = Camera.stack([look_at(0.0, 0.0, 1.3, target=(0.0, -0.12, 0.0), fov_y=26.0, size=64)])
    none = torch.zeros(1, 64, 64)
    params = HeadParameters.zeros(head, 1)
    found = fit_torso(head, params, torch.zeros(head.bust.vertex, 3), camera, none, none)
    assert float(found.offset.abs().max()) < 1e-6
    assert float(found.turns.abs().max()) < 1e-6


def test_rays_leave_a_disc_at_its_radius_and_not_at_the_photos_edge() -> None:
    row, column = np.mgrid[:100, :100] + 0.5
    disc = (np.hypot(row - 50, column - 40) < 30).astype(np.float32)
    inside = (column > 20).astype(np.float32)
    rays = directions(8)
    found = first_exits(disc, inside, np.array([40.0, 50.0]), rays)
    left = rays[:, 0] < -0.5
    assert np.isnan(found[left]).all()
    np.testing.assert_allclose(found[~left & (np.abs(rays[:, 0]) > 0.5)], 30, atol=0.7)


def test_the_last_edge_is_found() -> None:
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 10 + 50
    inner = (square - 50) / 2 + 50
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4]])
    distance, edge, share = far_crossings(
        np.concatenate((square, inner)), edges, np.array([50.0, 50.0]), np.array([[1.0, 0.0], [0.0, -1.0]])
    )
    np.testing.assert_allclose(distance, [10, 10])
    assert edge.tolist() == [1, 0]
    np.testing.assert_allclose(share, [0.5, 0.5])
