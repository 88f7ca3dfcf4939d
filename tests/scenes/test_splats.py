from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import scenes
from drjit_splat import rasterization
from scenes.colour import srgb_to_linear
from scenes.head_scene import load_head_scene
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


def test_a_missing_avatar_is_named(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"missing\.avatar"):
        scene_file(tmp_path, tmp_path / "missing.avatar", 1.0)


def test_the_head_stands_among_other_scenes() -> None:
    head_scene = load_head_scene(sphere_head(), 16, 16, "studio", "direct")
    assert head_scene.shape("head") is not None and head_scene.shape("nobody") is None


@pytest.mark.parametrize("kind", ["orthographic", "thinlens", "radiancemeter"])
def test_sensors_without_a_pinhole_are_named(kind: str, avatar: tuple[Avatar, Path], tmp_path: Path) -> None:
    mi = scenes.load_mitsuba()
    scene = scene_file(tmp_path, avatar[1], 0.1)
    film = {"type": "hdrfilm", "width": 1, "height": 1, "filter": {"type": "box"}}
    more = {"aperture_radius": 0.1, "focus_distance": 1.0} if kind == "thinlens" else {}
    sensor = mi.load_dict({"type": kind, "film": film, **more})
    with pytest.raises((ValueError, RuntimeError), match="gaussian_splats' needs a perspective sensor"):
        scene.integrator().render(scene, sensor)
