import pytest
import torch

from uika.head import HeadModel, look_at, project, rasterize


def jittered_grid(cells: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A triangulated square from edge to edge of the image, its inner vertices on quarter pixels."""
    axis = torch.linspace(0, size, cells + 1)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    noise = (torch.rand(cells + 1, cells + 1, 2, generator=torch.Generator().manual_seed(3)) - 0.5) * size / cells / 2
    noise[0], noise[-1], noise[:, 0], noise[:, -1] = 0, 0, 0, 0
    points = ((torch.stack((x, y), -1) + noise) * 4).round() / 4
    ids = torch.arange((cells + 1) ** 2).view(cells + 1, cells + 1)
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]
    faces = torch.cat([torch.stack(t, -1).view(-1, 3) for t in ((a, d, c), (a, c, b))])
    return points.view(-1, 2), faces


def test_watertight_covers_a_closed_grid_and_strict_leaves_edges_out() -> None:
    points, faces = jittered_grid(13, 64)
    triangle, barycentric = rasterize(points, faces, 64, 64)
    assert bool((triangle >= 0).all())
    rebuilt = (points[faces[triangle]] * barycentric[..., None]).sum(-2)
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    torch.testing.assert_close(rebuilt, torch.stack((x, y), -1), atol=1e-4, rtol=0)
    strict, _ = rasterize(points, faces, 64, 64, rule="strict")
    holes = strict < 0
    assert 0 < int(holes.sum()) < 400
    assert torch.equal(strict[~holes], triangle[~holes])


def test_shared_vertex_on_a_pixel_centre_has_one_owner() -> None:
    points = torch.tensor([[2.5, 2.5], [0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [0.0, 5.0]])
    fan = torch.tensor([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4]])
    triangle, barycentric = rasterize(points, fan, 5, 5)
    assert int(triangle[2, 2]) == 0
    torch.testing.assert_close(barycentric[2, 2], torch.tensor([1.0, 0.0, 0.0]))


def test_culling_keeps_the_camera_facing_side(head: HeadModel) -> None:
    camera = look_at(yaw=20, distance=0.6, size=64)
    xy, z = project(head.template, camera)
    front, _ = rasterize(xy, head.faces, 64, 64, z)
    both, _ = rasterize(xy, head.faces, 64, 64, z, cull="none")
    assert torch.equal(front, both) and int((front >= 0).sum()) > 500
    away, _ = rasterize(xy, head.faces.flip(1), 64, 64, z)
    a, b, c = head.template[head.faces[away[away >= 0]]].unbind(1)
    view = a - camera.position
    assert bool(((torch.linalg.cross(b - a, c - a) * view).sum(-1) > 0).all())


def test_depth_decides_and_barycentrics_are_perspective_correct() -> None:
    corners = torch.tensor([[-1.0, -1.0, 1.0], [1.0, -1.0, 3.0], [0.0, 1.0, 2.0]])
    near = corners * 0.5
    world = torch.cat((corners, near))
    xy = 20 * world[:, :2] / world[:, 2:] + 24
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    triangle, barycentric = rasterize(xy, faces, 48, 48, world[:, 2], cull="none")
    covered = triangle >= 0
    assert set(triangle[covered].tolist()) == {1}
    points = (world[faces[triangle[covered]]] * barycentric[covered][..., None]).sum(1)
    row, column = covered.nonzero().unbind(1)
    expected = torch.stack((column, row), 1) + 0.5
    torch.testing.assert_close(20 * points[:, :2] / points[:, 2:] + 24, expected, atol=1e-3, rtol=0)


def test_triangles_behind_empty_and_non_finite_input_give_nothing() -> None:
    points = torch.tensor([[0.0, 0.0], [0.0, 9.0], [9.0, 9.0]])
    faces = torch.tensor([[0, 1, 2]])
    assert int(rasterize(points, faces, 8, 8)[0].max()) == 0
    for bad in (torch.tensor([1.0, 1.0, -1.0]), torch.tensor([0.0, 1.0, 1.0])):
        assert int(rasterize(points, faces, 8, 8, bad)[0].max()) == -1
    assert int(rasterize(points / 0, faces, 8, 8)[0].max()) == -1
    assert int(rasterize(points, faces[:0], 8, 8)[0].max()) == -1
    assert int(rasterize(points + 1e12, faces, 8, 8)[0].max()) == -1


def test_large_images_are_done_in_parts(monkeypatch: pytest.MonkeyPatch, head: HeadModel) -> None:
    xy, z = project(head.template, look_at(distance=0.6, size=64))
    whole = rasterize(xy, head.faces, 64, 64, z, cull="none")
    monkeypatch.setattr("uika.head.raster._CHUNK_PAIRS", 50)
    for one, other in zip(whole, rasterize(xy, head.faces, 64, 64, z, cull="none"), strict=True):
        assert torch.equal(one, other)


def test_bad_arguments_are_named() -> None:
    points, faces = torch.zeros(3, 2), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match="depth has shape"):
        rasterize(points, faces, 8, 8, torch.ones(2))
    with pytest.raises(ValueError, match="rule='loose'"):
        rasterize(points, faces, 8, 8, rule="loose")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must be"):
        rasterize(torch.zeros(3, 3), faces, 8, 8)
