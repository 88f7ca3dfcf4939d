"""Random light for the scenes of the library, and pictures to stand behind a head."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scenes.head_scene import Light

_LIGHTS: tuple[Light, ...] = ("studio", "environment", "side", "portrait")
_ODDS = (0.4, 0.35, 0.1, 0.15)
_SKY_HEIGHT = 32


@dataclass(frozen=True, eq=False)
class Lighting:
    """A scene of the library with its lamps set."""

    light: Light
    values: Mapping[str, np.ndarray]  # for `HeadScene.set_lights`
    brightness: float  # mean radiance of a white face that the exposure aims at


def sample_lighting(random: np.random.Generator) -> Lighting:
    """Choose a scene and set all that may differ between two uses of it."""
    light = _LIGHTS[random.choice(len(_LIGHTS), p=_ODDS)]
    brightness = random.uniform(0.75, 1.15)
    if light == "environment":
        return Lighting(light, {"room.data": _sky(random)}, brightness)
    values: dict[str, np.ndarray] = {}
    key = 10 ** random.uniform(0.6, 1.3)
    if light == "studio":
        values["room.radiance.value"] = _grey(random.uniform(0.25, 0.9))
        values["key.emitter.radiance.value"] = _warm(random, key)
        values["key.to_world"] = _lamp(random, (-75, 75), (15, 60), random.uniform(0.3, 0.7))
        values["fill.emitter.radiance.value"] = _warm(random, 0.3 * key * random.random())
        values["fill.to_world"] = _lamp(random, (-90, 90), (0, 50), 0.7)
        values["rim.emitter.radiance.value"] = _warm(random, key * random.random())
        values["rim.to_world"] = _lamp(random, (140, 220), (20, 60), 0.4)
    elif light == "side":
        side = random.choice((-1.0, 1.0))
        values["room.radiance.value"] = _grey(random.uniform(0.05, 0.3))
        values["key.emitter.radiance.value"] = _warm(random, 100.0)
        values["key.to_world"] = _lamp(random, (45, 110), (5, 50), random.uniform(0.1, 0.2), side)
    else:
        values["room.radiance.value"] = _grey(random.uniform(0.15, 0.5))
        values["key.emitter.radiance.value"] = _warm(random, 7.0)
        values["key.to_world"] = _lamp(random, (-35, 35), (25, 60), 0.6)
    return Lighting(light, values, brightness)


def backdrop(random: np.random.Generator, size: int) -> np.ndarray:
    """An out-of-focus backdrop [S,S,3], sRGB in [0,1]: one colour, a gradient or blurred patches."""
    from PIL import Image

    tone = random.uniform(0.08, 0.95) + random.normal(0, 0.08, 3)
    kind = random.integers(3)
    if kind == 0:
        return np.broadcast_to(np.clip(tone, 0, 1), (size, size, 3)).astype(np.float32)
    cells = 2 if kind == 1 else int(random.integers(4, 10))
    patches = (
        tone
        + random.normal(0, 0.1 if kind == 1 else 0.2, (cells, cells, 1))
        + random.normal(0, 0.05, (cells, cells, 3))
    )
    small = Image.fromarray((np.clip(patches, 0, 1) * 255).astype(np.uint8))
    return np.asarray(small.resize((size, size), Image.Resampling.BICUBIC), np.float32) / 255


def _sky(random: np.random.Generator) -> np.ndarray:
    """A latitude-longitude picture [H,2H,3]: sky, ground and a few lamps or windows."""
    height = _SKY_HEIGHT
    polar = np.pi * (np.arange(height) + 0.5) / height
    around = 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    up = np.cos(polar)[:, None] * np.ones_like(around)
    directions = np.stack((np.sin(polar)[:, None] * np.sin(around), up, np.sin(polar)[:, None] * np.cos(around)), -1)
    share = 1 / (1 + np.exp(-random.uniform(2, 10) * up))[..., None]
    picture = share * _warm(random, random.uniform(0.4, 1.2)) + (1 - share) * _warm(random, random.uniform(0.05, 0.5))
    for _ in range(random.integers(1, 5)):
        toward = random.normal(size=3) * (1, 0.5, 1) + (0, 0.5, 0)
        toward /= np.linalg.norm(toward)
        sharp = 10 ** random.uniform(0.7, 2.2)
        lobe = np.exp(sharp * (directions @ toward - 1))[..., None]
        picture = picture + lobe * _warm(random, sharp**0.8 * random.uniform(0.2, 1.0))
    return picture.astype(np.float32)


def _warm(random: np.random.Generator, radiance: float) -> np.ndarray:
    warmth = random.uniform(-0.12, 0.22)
    return np.array([radiance * (1 + warmth), radiance, radiance * (1 - warmth)])


def _grey(radiance: float) -> np.ndarray:
    return np.full(3, radiance)


def _lamp(
    random: np.random.Generator,
    yaw: tuple[float, float],
    pitch: tuple[float, float],
    half_size: float,
    side: float = 1.0,
) -> np.ndarray:
    """Transform [4,4] of a square lamp 2.4 m away that faces the head, at random angles within the ranges (degrees).

    A `side` of -1 puts it on the head's right.
    """
    a, b = np.deg2rad(side * random.uniform(*yaw)), np.deg2rad(random.uniform(*pitch))
    back = np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    result = np.eye(4)
    result[:3, :3] = half_size * np.stack((-right, np.cross(-back, -right), -back), -1)
    result[:3, 3] = 2.4 * back
    return result
