"""What happens to pictures on the way from a scene to a user's disk: light, lens, sensor, compression, hands."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

_ODDS = {"blur": 0.4, "noise": 0.5, "jpeg": 0.6, "occlusion": 0.15}
_BLUR = (0.4, 1.6)  # pixels at 256
_NOISE = (0.004, 0.03)
_QUALITY = (35, 95)


@dataclass(frozen=True)
class Grade:
    """A change of colours that a camera or its software makes: gains [3], gamma, contrast, grey instead of colour."""

    gains: tuple[float, ...] = (1.0, 1.0, 1.0)
    gamma: float = 1.0
    contrast: float = 1.0
    grey: bool = False

    def __call__(self, image: Tensor) -> Tensor:
        """Images [...,3,H,W] in [0,1] -> the same, graded."""
        gains = image.new_tensor(self.gains)[:, None, None]
        if self.grey:
            image = image.mean(-3, keepdim=True).expand_as(image)
        graded = (image.clamp(0, 1) ** self.gamma * gains - 0.5) * self.contrast + 0.5
        return graded.clamp(0, 1)


def draw_grade(random: np.random.Generator, strength: float = 1.0, grey: float = 0.0) -> Grade:
    """A random grade; the shared one of a head has strength 1, what its photos differ by much less.

    `grey` are the odds that it takes the colours away.
    """
    warmth, level = strength * random.uniform(-0.1, 0.1), strength * random.uniform(-0.12, 0.12)
    tint = strength * random.uniform(-0.04, 0.04)
    gains = tuple(1 + level + part for part in (warmth, tint, -warmth))
    return Grade(
        gains,
        float(np.exp(strength * random.uniform(-0.25, 0.25))),
        1 + strength * random.uniform(-0.12, 0.12),
        grey > 0 and random.random() < grey,
    )


def degrade(image: Tensor, random: np.random.Generator) -> Tensor:
    """A photo [3,H,W] in [0,1] with something before it, out of focus, noisy and compressed, each at random."""
    size = image.shape[-1]
    if random.random() < _ODDS["occlusion"]:
        image = _occlude(image, random)
    if random.random() < _ODDS["blur"]:
        image = gaussian_blur(image, random.uniform(*_BLUR) * size / 256)
    if random.random() < _ODDS["noise"]:
        grain = random.normal(size=tuple(image.shape)).astype(np.float32)
        image = (image + random.uniform(*_NOISE) * torch.from_numpy(grain)).clamp(0, 1)
    if random.random() < _ODDS["jpeg"]:
        image = _compress(image, int(random.integers(*_QUALITY)))
    return image


def gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Blur an image [C,H,W]; its border is repeated outwards. `sigma` in pixels."""
    reach = max(1, round(3 * sigma))
    place = torch.arange(-reach, reach + 1, dtype=image.dtype)
    window = (-place.square() / (2 * sigma**2)).exp()
    window = (window / window.sum()).expand(len(image), 1, 1, -1)
    padded = functional.pad(image[None], (reach,) * 4, mode="replicate")
    across = functional.conv2d(padded, window, groups=len(image))
    return functional.conv2d(across, window.mT, groups=len(image))[0]


def _occlude(image: Tensor, random: np.random.Generator) -> Tensor:
    """An ellipse of one rough colour: a hand, a microphone, a strand of hair."""
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(*((torch.arange(side) + 0.5) / side for side in (height, width)), indexing="ij")
    centre_x, centre_y = random.uniform(0.15, 0.85, 2)
    angle = random.uniform(0, np.pi)
    along, across = random.uniform(0.05, 0.3), random.uniform(0.02, 0.12)
    u = (x - centre_x) * np.cos(angle) + (y - centre_y) * np.sin(angle)
    v = (y - centre_y) * np.cos(angle) - (x - centre_x) * np.sin(angle)
    inside = (u / along) ** 2 + (v / across) ** 2 < 1
    coarse = random.normal(0, 0.08, (1, 3, 5, 5)).astype(np.float32) + random.uniform(0.05, 0.95, (1, 3, 1, 1))
    colour = functional.interpolate(torch.from_numpy(coarse.astype(np.float32)), size=(height, width), mode="bicubic")
    return torch.where(inside, colour[0].clamp(0, 1), image)


def _compress(image: Tensor, quality: int) -> Tensor:
    from PIL import Image

    pixels = (image.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=quality)
    return torch.from_numpy(np.array(Image.open(buffer))).permute(2, 0, 1).float() / 255
