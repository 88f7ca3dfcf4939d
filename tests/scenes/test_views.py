import numpy as np
import pytest
import torch

from scenes import linear_to_srgb
from scenes.synthesis.lighting import sample_lighting
from scenes.synthesis.shading import pixel_pattern
from tests.heads import sphere_head
from uika.head import Camera, look_at

pytest.importorskip("mitsuba", reason="skipped: Mitsuba is not installed")


@pytest.mark.parametrize("spp", [1, 4, 16])
def test_patterns_lie_around_the_centre_and_share_no_line(spp: int) -> None:
    points = np.array(pixel_pattern(spp))
    assert len(points) == spp and points[0].tolist() == [0.5, 0.5]
    np.testing.assert_allclose(points.mean(0), 0.5, atol=1e-9)
    assert points.min() >= 0 and points.max() <= 1
    for axis in points.T:
        assert len(np.unique(axis.round(6))) == spp


def test_an_unknown_pattern_is_refused() -> None:
    with pytest.raises(ValueError, match="spp must be one of"):
        pixel_pattern(5)


def test_lamps_of_every_seed_can_be_drawn() -> None:
    sides = set()
    for seed in range(200):
        lighting = sample_lighting(np.random.default_rng(seed))
        if lighting.light == "side":
            sides.add(np.sign(lighting.values["key.to_world"][0, 3]))
    assert sides == {-1.0, 1.0}


def test_stored_views_are_the_single_views_rounded() -> None:
    from scenes.synthesis.deferred import Shader, as_texture
    from scenes.synthesis.vertex_light import lit_scene

    head = sphere_head()
    texture = as_texture(np.random.default_rng(0).random((16, 16, 3)), np.full((16, 16), 0.5))
    shader = Shader(lit_scene(head, "studio"), head, head.template, texture)
    cameras = [look_at(yaw, distance=0.8, fov_y=20, size=40) for yaw in (-30, 0, 50)]
    away = look_at(0, distance=0.8, fov_y=20, size=40)
    cameras.append(Camera(away.viewmat, away.K + torch.tensor([[0, 0, 400.0], [0, 0, 0], [0, 0, 0]]), 40, 40))
    backdrops = [np.random.default_rng(i).integers(0, 256, (40, 40, 3)).astype(np.uint8) for i in range(4)]
    stored = list(shader.stored_views(cameras, backdrops, 65534, 1e-4))
    assert len(stored) == 4
    for camera, backdrop, found in zip(cameras, backdrops, stored, strict=True):
        seen = shader.view(camera, 4, ("uv", "depth", "triangle"))
        alpha = seen["mask"][..., None]
        expected = 255 * (linear_to_srgb(seen["rgb"]) * alpha) + backdrop * (1 - alpha)
        np.testing.assert_allclose(found.rgb, expected, atol=0.51)
        np.testing.assert_allclose(found.mask, 255 * seen["mask"], atol=0.51)
        np.testing.assert_allclose(found.depth * 1e-4, seen["depth"], atol=0.51e-4)
        hit = seen["triangle"] >= 0
        assert (found.uv[~hit] == 0).all() and (found.uv[hit] > 0).all()
        np.testing.assert_allclose((found.uv[hit] - 1.0) / 65534, seen["uv"][hit], atol=1e-5)
    assert not stored[3].mask.any() and (stored[3].rgb == backdrops[3]).all()
