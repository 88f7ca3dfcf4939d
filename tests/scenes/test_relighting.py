"""Relit avatars against Mitsuba: same head, reflectance and surroundings."""

import numpy as np
import pytest
import torch

from scenes.colour import srgb_to_linear
from scenes.head_scene import load_head_scene
from scenes.variant import keeping_variant, load_mitsuba
from tests.avatars import surface_avatar
from uika.avatar import Avatar
from uika.avatar.relighting import relit
from uika.avatar.rendering import render
from uika.head import HeadModel, HeadParameters, load_head, look_at
from uika.head.light import COUNT, from_environment, harmonics, to_linear

SIZE = 96
ALBEDO = (0.55, 0.45, 0.4)  # sRGB
HEIGHT = 32


def white_light() -> torch.Tensor:
    light = torch.zeros(COUNT, 3)
    light[0] = 1 / harmonics(torch.tensor([0.0, 0.0, 1.0]))[0]
    return light


def even_avatar(head: HeadModel, size: int) -> Avatar:
    from dataclasses import replace

    avatar = surface_avatar(
        head, size, lambda _, binding: torch.tensor(ALBEDO).expand(len(binding), 3).contiguous(), opacity=0.99
    )
    return replace(avatar, light=white_light())


def sky(side: float) -> np.ndarray:
    """A grey room with one large lamp above the face and to the side of a head."""
    polar = np.pi * (np.arange(HEIGHT) + 0.5) / HEIGHT
    around = 2 * np.pi * (0.5 - (np.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT))
    x = np.sin(polar)[:, None] * np.sin(around)
    y = np.cos(polar)[:, None] * np.ones_like(around)
    z = np.sin(polar)[:, None] * np.cos(around)
    toward = np.array([side, 0.5, 0.7]) / np.linalg.norm([side, 0.5, 0.7])
    lamp = np.exp(4 * (x * toward[0] + y * toward[1] + z * toward[2] - 1))[..., None]
    return np.ascontiguousarray(0.3 + lamp * np.array([2.0, 1.8, 1.5]), np.float32)


@keeping_variant()
def mitsuba_picture(head: HeadModel, camera: object, environment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scene = load_head_scene(head, SIZE, SIZE, "environment", "direct")
    scene.set_lights({"room.data": environment})
    specular = next(name for name, _ in scene.params if name.startswith("head.bsdf") and "specular" in name)
    shine = scene.params[specular]
    scene.params[specular] = 0.0
    texture = srgb_to_linear(np.full((2, 2, 3), ALBEDO, np.float32))
    scene.update(head, head.template, camera, texture, np.ones((2, 2), np.float32))  # type: ignore[arg-type]
    image = np.array(load_mitsuba().render(scene.scene, spp=64, seed=0))
    scene.params[specular] = shine
    scene.set_lights({})
    return image[..., :3], image[..., 3]


@pytest.mark.parametrize("side", [-0.9, 0.9])
def test_relit_head_looks_like_mitsubas(side: float) -> None:
    head = load_head()
    camera = look_at(15.0, 0.0, 1.2, fov_y=18.0, size=SIZE)
    environment = sky(side)
    avatar = relit(even_avatar(head, 160), head, from_environment(torch.from_numpy(environment)), exposed=False)
    picture = render(avatar, HeadParameters.zeros(head), camera, head, (0.0, 0.0, 0.0))
    true, mask = mitsuba_picture(head, camera, environment)
    inside = torch.from_numpy(mask > 0.999) & (picture.alpha > 0.99)
    error = to_linear(picture.rgb)[inside] - torch.from_numpy(true)[inside]
    flat = to_linear(torch.tensor(ALBEDO)) - torch.from_numpy(true)[inside]
    psnr, before = (float(-10 * torch.log10(e.square().mean())) for e in (error, flat))
    print(f"relit {psnr:.1f} dB, as it was {before:.1f} dB")
    assert inside.sum() > 1500
    assert psnr > 24
    assert psnr > before + 6
