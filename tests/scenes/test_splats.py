from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import scenes
from drjit_splat import load_ply, rasterization, save_ply, sh_colors
from scenes.colour import srgb_to_linear
from scenes.head_scene import load_head_scene
from scenes.splats import SplatView, opencv_view
from tests.heads import sphere_head
from uika.avatar import Avatar
from uika.head import look_at

SIZE = 48
CAMERA = look_at(yaw=10, distance=0.8, fov_y=20, size=SIZE)


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> tuple[Avatar, Path]:
    """A slab of splats, half of it in front of the plane z = 0 and half behind it."""
    generator = torch.Generator().manual_seed(0)
    count = 400
    spread = torch.rand(count, 3, generator=generator) - 0.5
    avatar = Avatar(
        head_id="none",
        identity=torch.zeros(1),
        static_offset=torch.zeros(3, 3),
        means=spread * torch.tensor([0.2, 0.2, 0.1]),
        quats=torch.randn(count, 4, generator=generator),
        scales=0.002 + 0.004 * torch.rand(count, 3, generator=generator),
        opacities=0.2 + 0.7 * torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
        triangle=torch.zeros(count, dtype=torch.int64),
        barycentric=torch.tensor([[1.0, 0.0, 0.0]]).expand(count, 3).contiguous(),
    )
    path = tmp_path_factory.mktemp("avatar") / "slab.avatar"
    avatar.save(path)
    return avatar, path


def scene_file(folder: Path, avatar: Path, radius: float) -> Any:
    """A scene of a glowing disc in the plane z = 0 with the avatar around it."""
    mi = scenes.load_mitsuba()
    scenes.register_plugins()
    to_world = np.linalg.inv(CAMERA.viewmat.double().numpy()) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    fov = 2 * np.degrees(np.arctan(SIZE / (2 * float(CAMERA.K[0, 0]))))
    matrix = " ".join(f"{value:.9f}" for value in to_world.ravel())
    file = folder / "scene.xml"
    file.write_text(f"""<scene version="3.0.0">
    <integrator type="gaussian_splats">
        <string name="filename" value="{avatar}"/>
        <integrator type="direct"/>
    </integrator>
    <sensor type="perspective">
        <transform name="to_world"><matrix value="{matrix}"/></transform>
        <float name="fov" value="{fov}"/>
        <string name="fov_axis" value="x"/>
        <film type="hdrfilm">
            <integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
            <string name="pixel_format" value="rgba"/><rfilter type="box"/>
        </film>
    </sensor>
    <shape type="disk">
        <transform name="to_world"><scale value="{radius}"/></transform>
        <emitter type="area"><rgb name="radiance" value="0.1, 0.5, 0.9"/></emitter>
    </shape>
</scene>""")
    return mi.load_file(str(file))


def splatted(avatar: Avatar, colors: torch.Tensor, keep: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    image, alpha, _ = rasterization(
        avatar.means,
        avatar.quats,
        avatar.scales,
        avatar.opacities * keep,
        colors,
        CAMERA.viewmat[None],
        CAMERA.K[None],
        SIZE,
        SIZE,
    )
    return image[0], alpha[0]


def test_a_scene_file_shows_the_avatar_in_front_of_a_mesh(avatar: tuple[Avatar, Path], tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    slab, path = avatar
    # A disc that fills the frame hides the half behind it.
    image = np.array(mi.render(scene_file(tmp_path, path, 1.0), spp=4))
    linear = torch.from_numpy(srgb_to_linear(slab.colors.numpy()))
    front, alpha = splatted(slab, linear, slab.means[:, 2] > 0)
    expected = front + (1 - alpha) * torch.tensor([0.1, 0.5, 0.9])
    np.testing.assert_allclose(image[..., :3], expected, atol=2e-5)
    np.testing.assert_allclose(image[..., 3], 1, atol=1e-5)
    # A disc too small to hide anything leaves the avatar as drjit_splat draws it.
    alone = np.array(mi.render(scene_file(tmp_path, path, 1e-6), spp=4))
    every, alpha = splatted(slab, linear, torch.ones(len(slab)))
    np.testing.assert_allclose(alone[..., :3], every, atol=2e-5)
    np.testing.assert_allclose(alone[..., 3:], alpha, atol=2e-5)


def test_gradients_of_the_colours_are_those_of_drjit_splat(avatar: tuple[Avatar, Path], tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    import drjit as dr

    slab, path = avatar
    scene = scene_file(tmp_path, path, 1.0)
    params = mi.traverse(scene.integrator())
    dr.enable_grad(params["colors"])
    image = mi.render(scene, params, integrator=scene.integrator(), spp=1)
    weights = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(1))
    dr.backward(dr.sum(image[..., :3] * mi.TensorXf(weights.numpy()), axis=None))
    found = np.array(dr.grad(params["colors"])).reshape(-1, 3)
    colors = torch.from_numpy(srgb_to_linear(slab.colors.numpy())).requires_grad_()
    front, _ = splatted(slab, colors, slab.means[:, 2] > 0)
    (front * weights).sum().backward()
    assert colors.grad is not None and float(colors.grad.abs().max()) > 1
    np.testing.assert_allclose(found, colors.grad, atol=1e-4)


def test_colours_can_be_optimised_through_the_scene(avatar: tuple[Avatar, Path], tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    import drjit as dr

    scene = scene_file(tmp_path, avatar[1], 1.0)
    integrator = scene.integrator()
    target = mi.TensorXf(np.array(mi.render(scene, spp=1)))
    params = mi.traverse(integrator)
    params["colors"] = dr.full(mi.Float, 0.5, dr.width(params["colors"]))
    params.update()
    optimiser = mi.ad.Adam(lr=0.1, params={"colors": params["colors"]})
    losses = []
    for _ in range(8):
        params.update(optimiser)
        loss = dr.mean(dr.square(mi.render(scene, params, integrator=integrator, spp=1) - target), axis=None)
        dr.backward(loss)
        optimiser.step()
        losses.append(float(np.array(loss).ravel()[0]))
    assert losses[-1] < 0.3 * losses[0]


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A splat scene with harmonics of the second degree, in front of the plane z = 0."""
    random = torch.Generator().manual_seed(4)
    count = 60
    means = (torch.rand(count, 3, generator=random) - 0.5) * torch.tensor([0.2, 0.2, 0.05]) + torch.tensor([0, 0, 0.05])
    path = tmp_path_factory.mktemp("scene") / "blobs.ply"
    save_ply(
        path,
        means,
        torch.randn(count, 4, generator=random),
        0.01 + 0.01 * torch.rand(count, 3, generator=random),
        0.2 + 0.6 * torch.rand(count, generator=random),
        0.3 * torch.randn(count, 9, 3, generator=random),
    )
    return path


def linear_picture(values: dict[str, torch.Tensor], view: SplatView) -> tuple[torch.Tensor, torch.Tensor]:
    """What the integrator shall show of a splat scene, with gradients."""
    if view.model == "ortho":
        directions = view.viewmat[2, :3].expand(len(values["means"]), 3)
    else:
        eye = torch.linalg.inv(view.viewmat)[:3, 3]
        directions = torch.nn.functional.normalize(values["means"] - eye, dim=-1)
    srgb = sh_colors(values["harmonics"], directions, 2).clamp(0, 1)
    linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
    image, alpha, _ = rasterization(
        *(values[name] for name in ("means", "quats", "scales", "opacities")),
        linear,
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        camera_model=view.model,
    )
    return image[0], alpha[0]


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_splat_scene_is_seen_by_pinhole_and_parallel_rays(ply: Path, tmp_path: Path, kind: str) -> None:
    mi = scenes.load_mitsuba()
    scene = scene_file(tmp_path, ply, 1.0)
    sensor = scene.sensors()[0]
    if kind == "orthographic":
        T = mi.ScalarTransform4f
        to_world = T().look_at([0.3, 0.1, 1.0], [0, 0, 0], [0, 1, 0]) @ T().scale([0.15, 0.15, 1.0])
        film = {"type": "hdrfilm", "width": 40, "height": 30, "pixel_format": "rgba", "rfilter": {"type": "box"}}
        sensor = mi.load_dict({"type": "orthographic", "to_world": to_world, "film": film})
    image = np.array(scene.integrator().render(scene, sensor, spp=4))
    view = opencv_view(mi, sensor)
    front, alpha = linear_picture(vars(load_ply(ply)), view)
    behind = np.array(scene.integrator().meshes.render(scene, sensor, spp=4))[..., :3]
    assert alpha.max() > 0.5
    np.testing.assert_allclose(image[..., :3], front + (1 - alpha) * torch.from_numpy(behind), atol=3e-5)


def test_a_parallel_sensor_sees_meshes_and_splats_at_the_same_pixels(tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    places = torch.tensor([[0.05, 0.02, 0.1], [-0.08, 0.06, 0.1], [0.0, -0.07, 0.1]])
    ones = torch.ones(3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4)
    save_ply(tmp_path / "dots.ply", places, quats, 0.003 * torch.ones(3, 3), 0.99 * ones, torch.ones(3, 3))
    T = mi.ScalarTransform4f
    to_world = T().look_at([0.4, 0.2, 1.0], [0, 0, 0], [0, 1, 0]) @ T().scale([0.2, 0.2, 1.0])
    film = {"type": "hdrfilm", "width": 64, "height": 48, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "orthographic", "to_world": to_world, "film": film})
    alone = scene_file(tmp_path, tmp_path / "dots.ply", 1e-6)
    dots = np.array(alone.integrator().render(alone, sensor, spp=1))[..., 3]
    spheres = {
        f"s{k}": {"type": "sphere", "center": place.tolist(), "radius": 0.006, "emitter": {"type": "area"}}
        for k, place in enumerate(places)
    }
    lit = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, **spheres})
    meshes = np.array(mi.render(lit, sensor=sensor, spp=1024))
    rows, columns = np.mgrid[:48, :64]
    for picture in (dots, meshes[..., 3]):
        assert picture.max() > 0.5

    def centre(picture: np.ndarray) -> np.ndarray:
        return np.array([(picture * rows).sum(), (picture * columns).sum()]) / picture.sum()

    # The shares of three small spheres in the mean are known to a percent of their distance, 20 pixels.
    assert np.abs(centre(dots) - centre(meshes[..., 3])).max() < 0.3


def test_every_parameter_of_a_splat_scene_has_the_gradient_of_drjit_splat(ply: Path, tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    import drjit as dr

    scene = scene_file(tmp_path, ply, 1.0)
    params = mi.traverse(scene.integrator())
    names = ("means", "quats", "scales", "opacities", "harmonics")
    for name in names:
        dr.enable_grad(params[name])
    weights = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(1))
    image = mi.render(scene, params, integrator=scene.integrator(), spp=1)
    dr.backward(dr.sum(image[..., :3] * mi.TensorXf(weights.numpy()), axis=None))
    values = {name: value.clone().requires_grad_() for name, value in vars(load_ply(ply)).items()}
    front, alpha = linear_picture(values, opencv_view(mi, scene.sensors()[0]))
    ((front + (1 - alpha) * torch.tensor([0.1, 0.5, 0.9])) * weights).sum().backward()
    for name in names:
        expected = values[name].grad
        assert expected is not None and float(expected.abs().max()) > 0
        found = np.array(dr.grad(params[name])).reshape(expected.shape)
        np.testing.assert_allclose(found, expected, atol=2e-4 * float(expected.abs().max()))


def test_a_missing_avatar_is_named(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"missing\.avatar"):
        scene_file(tmp_path, tmp_path / "missing.avatar", 1.0)


def test_the_head_stands_among_other_scenes() -> None:
    head_scene = load_head_scene(sphere_head(), 16, 16, "studio", "direct")
    assert head_scene.shape("head") is not None and head_scene.shape("nobody") is None


@pytest.mark.parametrize("kind", ["thinlens", "radiancemeter"])
def test_sensors_without_a_pinhole_are_named(kind: str, avatar: tuple[Avatar, Path], tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    scene = scene_file(tmp_path, avatar[1], 0.1)
    film = {"type": "hdrfilm", "width": 1, "height": 1, "filter": {"type": "box"}}
    more = {"aperture_radius": 0.1, "focus_distance": 1.0} if kind == "thinlens" else {}
    sensor = mi.load_dict({"type": kind, "film": film, **more})
    with pytest.raises(
        (ValueError, RuntimeError), match="gaussian_splats' needs a perspective or an orthographic sensor"
    ):
        scene.integrator().render(scene, sensor)
