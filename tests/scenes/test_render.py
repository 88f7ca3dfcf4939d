import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import scenes
from scenes.head_scene import load_head_scene
from tests.heads import sphere_head
from uika.head import Camera, HeadModel, HeadParameters, look_at, pose_vertices, project, rasterize

ROOT = Path(__file__).resolve().parents[2]
Images = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def posed(head: HeadModel) -> torch.Tensor:
    params = HeadParameters.zeros(head).replace(
        rotation=torch.tensor([0.2, -0.3, 0.1]), jaw=torch.tensor([0.2, 0.0, 0.0]), identity=torch.ones(4)
    )
    return pose_vertices(head, params)


@pytest.fixture(scope="module")
def camera() -> Camera:
    centred = look_at(yaw=25, pitch=10, distance=0.8, fov_y=20, size=(96, 64))
    K = centred.K.clone()
    K[:2, 2] += torch.tensor([7.3, -4.1])
    return Camera(centred.viewmat, K, 96, 64)


@pytest.fixture(scope="module")
def images(head: HeadModel, posed: torch.Tensor, camera: Camera) -> Images:
    return scenes.render(posed, head, camera, aovs=scenes.AOVS, spp=4)


def hit_barycentrics(head: HeadModel, images: Images) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangles and barycentrics of the hits, from the UV and triangle images alone."""
    found = images["triangle"] >= 0
    triangle, uv = torch.from_numpy(images["triangle"][found]), torch.from_numpy(images["uv"][found]).double()
    corners = head.uvs.double()[head.uv_faces[triangle]]
    system = torch.cat((corners.mT, torch.ones(len(triangle), 1, 3)), 1)
    target = torch.stack((uv[:, 0], 1 - uv[:, 1], torch.ones(len(uv))), -1)
    return triangle, torch.linalg.solve(system, target)


def test_sensor_agrees_with_project(head: HeadModel, posed: torch.Tensor, camera: Camera, images: Images) -> None:
    triangle, barycentric = hit_barycentrics(head, images)
    points = (posed.double()[head.faces[triangle]] * barycentric[..., None]).sum(1)
    xy, z = project(points, camera)
    row, column = (images["triangle"] >= 0).nonzero()
    centres = torch.from_numpy(np.stack((column, row), -1) + 0.5)
    assert len(xy) > 500
    assert float((xy - centres).norm(dim=-1).max()) < 0.05
    np.testing.assert_allclose(images["depth"][row, column], z.numpy(), atol=1e-4)


def test_mitsuba_agrees_with_the_rasterizer(
    head: HeadModel, posed: torch.Tensor, camera: Camera, images: Images
) -> None:
    xy, z = project(posed, camera)
    triangle, barycentric = rasterize(xy, head.faces, 64, 96, z, cull="none")
    ours, theirs = triangle.numpy() >= 0, images["triangle"] >= 0
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.99
    same = ours & theirs & (triangle.numpy() == images["triangle"])
    assert same.sum() / ours.sum() > 0.99
    depth = (z[head.faces[triangle]] * barycentric).sum(-1).numpy()
    assert np.median(np.abs(depth - images["depth"])[same]) < 1e-5
    uv = (head.uvs[head.uv_faces[triangle]] * barycentric[..., None]).sum(-2).numpy()
    uv[..., 1] = 1 - uv[..., 1]
    assert np.median(np.abs(uv - images["uv"])[same]) < 1e-4


def test_background_values_and_ranges(images: Images) -> None:
    empty = images["triangle"] < 0
    assert images["rgb"].shape == (64, 96, 3) and images["uv"].shape == (64, 96, 2)
    assert (images["depth"][empty] == 0).all() and (images["uv"][empty] == 0).all()
    outside = images["mask"] == 0
    np.testing.assert_allclose(images["rgb"][outside], 1.0)
    inside = images["mask"] == 1
    assert inside.sum() > 500
    assert 0.2 < images["rgb"][inside].mean() < 0.9
    assert np.abs(images["mask"].sum() - (~empty).sum()) / (~empty).sum() < 0.02


def test_outline_is_not_dark_where_smooth_normals_turn_away() -> None:
    coarse = sphere_head(7, 9)
    images = scenes.render(coarse.template, coarse, look_at(25, 10, 0.8, size=128), aovs=("rgb", "mask"))
    assert images["rgb"][images["mask"] == 1].mean(-1).min() > 0.4


def test_only_what_is_asked_is_returned(head: HeadModel, posed: torch.Tensor, camera: Camera, images: Images) -> None:
    for names in (("mask",), ("depth", "triangle"), ("uv",)):
        some = scenes.render(posed, head, camera, aovs=names, spp=4)
        assert tuple(some) == names
        for name in names:
            np.testing.assert_array_equal(some[name], images[name])


def test_flat_light_shows_the_texture_itself(head: HeadModel, posed: torch.Tensor, camera: Camera) -> None:
    v, u = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="ij")
    texture = torch.stack((u, v, 0.5 * torch.ones_like(u)))
    flat = scenes.render(posed, head, camera, texture, ("rgb", "uv", "mask"), light="flat", background=(0, 0, 0))
    inside = flat["mask"] == 1
    np.testing.assert_allclose(flat["rgb"][inside][:, 2], 0.5, atol=2e-3)
    assert np.median(np.abs(flat["rgb"][..., :2] - flat["uv"])[inside]) < 0.01
    np.testing.assert_array_equal(flat["rgb"][flat["mask"] == 0], 0)
    grey = scenes.render(posed, head, camera, texture[:1] * 0 + 0.3, ("rgb",), light="flat")
    np.testing.assert_allclose(grey["rgb"][inside], 0.3, atol=2e-3)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="skipped: memory is read from /proc")
def test_repeated_renders_load_nothing_and_keep_no_memory(head: HeadModel, camera: Camera) -> None:
    def frames(count: int) -> None:
        for index in range(count):
            scenes.render(head.template * (1 + 0.01 * index), head, camera, spp=4)

    def resident_pages() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1])

    frames(3)
    loads = load_head_scene.cache_info().misses
    before = resident_pages()
    frames(12)
    assert load_head_scene.cache_info().misses == loads
    assert (resident_pages() - before) * os.sysconf("SC_PAGE_SIZE") < 20e6


def test_seed_decides_the_noise(head: HeadModel, camera: Camera) -> None:
    one, same, other = (scenes.render(head.template, head, camera, aovs=("rgb",), seed=s)["rgb"] for s in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-3


def test_bad_arguments_are_named(head: HeadModel, posed: torch.Tensor, camera: Camera) -> None:
    with pytest.raises(ValueError, match="normals"):
        scenes.render(posed, head, camera, aovs=("normals",))
    with pytest.raises(ValueError, match="vertices have shape"):
        scenes.render(posed[:-1], head, camera)
    with pytest.raises(ValueError, match="not finite"):
        scenes.render(posed * torch.nan, head, camera)
    with pytest.raises(ValueError, match="texture has shape"):
        scenes.render(posed, head, camera, torch.zeros(4, 8, 8))
    with pytest.raises(ValueError, match="light must be one of"):
        scenes.render(posed, head, camera, light="dark")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="square pixels"):
        scenes.render(posed, head, Camera(camera.viewmat, camera.K * torch.tensor([[1.0], [2.0], [1.0]]), 96, 64))


@pytest.mark.skipif("UIKA_HEAD" in os.environ, reason="skipped: another head is chosen")
def test_built_in_head_renders_like_the_rasterizer() -> None:
    from uika.head import load_head

    head = load_head()
    camera = look_at(yaw=-30, distance=0.8, size=96)
    images = scenes.render(head.template, head, camera, aovs=("triangle",))
    xy, z = project(head.template, camera)
    triangle, _ = rasterize(xy, head.faces, 96, 96, z, cull="none")
    assert (triangle.numpy() == images["triangle"]).mean() > 0.995


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no way to give a process one core")
@pytest.mark.parametrize("light", ["flat", "environment"])
def test_one_core_is_enough(light: str) -> None:
    """Mitsuba's own reading and writing of .exr files needs a second thread and would wait for ever."""
    program = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from scenes.head_scene import load_head_scene; from tests.heads import sphere_head\n"
        f"scene = load_head_scene(sphere_head(rows=7, columns=10), 16, 16, '{light}', 'path'); print('loaded')"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=90)
    assert done.stdout.strip().endswith("loaded"), done.stderr
