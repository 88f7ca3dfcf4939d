"""Mitsuba's meshes, areas and intersections against trimesh, which shares no code with it."""

import numpy as np
import pytest
import torch
import trimesh

import scenes
from scenes.head_scene import load_head_scene
from tests.heads import sphere_head
from uika.head import Camera, HeadModel, look_at

AREA = 1e-5  # of the area: Mitsuba adds triangles in single precision


def mesh_of(head: HeadModel) -> trimesh.Trimesh:
    return trimesh.Trimesh(head.template.numpy(), head.faces.numpy(), process=False)


def pixel_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [H*W,3] through the pixels' centres, in world coordinates."""
    row, column = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    pixels = torch.stack((column, row, torch.ones_like(row)), -1).reshape(-1, 3).double()
    to_world = torch.linalg.inv(camera.viewmat.double())
    directions = pixels @ torch.linalg.inv(camera.K.double()).T @ to_world[:3, :3].T
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return np.tile(to_world[:3, 3].numpy(), (len(directions), 1)), directions.numpy()


@pytest.mark.parametrize("sizes", [(7, 9), (24, 32)])
def test_areas_agree(sizes: tuple[int, int]) -> None:
    head = sphere_head(*sizes)
    head_scene = load_head_scene(head, 16, 16, "flat", "direct")
    (shape,) = (shape for shape in head_scene.scene.shapes() if shape.id() == "head")
    mesh = mesh_of(head)
    assert float(np.array(shape.surface_area()).item()) == pytest.approx(mesh.area, rel=AREA)


def test_intersections_agree(head: HeadModel) -> None:
    camera = look_at(yaw=25, pitch=10, distance=0.8, fov_y=20, size=(48, 32))
    images = scenes.render(head.template, head, camera, aovs=("triangle", "depth"))
    mesh = mesh_of(head)
    origins, directions = pixel_rays(camera)
    points, rays, triangles = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    assert len(rays) > 200
    ours = images["triangle"].reshape(-1)
    theirs = np.full(len(origins), -1)
    theirs[rays] = triangles
    # A pixel's centre on an edge belongs to either triangle.
    assert (ours == theirs).mean() > 0.995
    assert ((ours >= 0) != (theirs >= 0)).sum() <= 2
    depth = points @ camera.viewmat.double().numpy()[2, :3] + float(camera.viewmat[2, 3])
    hit = ours[rays] >= 0
    np.testing.assert_allclose(images["depth"].reshape(-1)[rays][hit], depth[hit], atol=2e-5)
