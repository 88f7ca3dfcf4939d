"""Square pictures for training out of samples of any size."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uika.data import Sample
from uika.data.head_crop import Square, head_square
from uika.head import Camera, HeadModel

SOLID = 0.98  # mask from which a pixel shows the person alone
_REACH = 8  # pixels that colours are continued beyond it
_ZOOM, _SHIFT = (0.85, 1.2), 0.05  # of a jittered crop, relative to the picture


class View:
    """A square view: foreground colours [3,S,S], mask [S,S], camera, and the exact labels where they are known.

    `image` has no backdrop: colours at the person's edge are continued from inside, to be composited with the mask.
    """

    def __init__(self, sample: Sample, size: int, head: HeadModel | None = None) -> None:
        """Cut the head out of a sample as `head_square` says, else pad the sample to a square, and resize it."""
        crop = None if head is None else head_square(sample, head)
        square = _squared(sample, _whole(sample) if crop is None else crop)
        mask = square["mask"]
        planes = torch.cat((_foreground(square["image"], mask), mask[None]))[None]
        if crop is None:
            planes = functional.interpolate(planes, size=(size, size), mode="area")[0]
        else:
            # Its side has no simple ratio to the picture's.
            planes = functional.interpolate(planes, size=(size, size), mode="bilinear", antialias=True)[0]
        self.image, self.mask = planes[:3], planes[3]
        self.camera = square["camera"].resized(size, size)
        self.key, self.sample = sample.key, sample
        self.parameters, self.static_offset = sample.parameters, sample.static_offset
        self.uv: Tensor | None = None
        if "uv" in square:
            self.uv = functional.interpolate(square["uv"][None], size=(size, size), mode="nearest-exact")[0]

    def over(self, background: Tensor, image: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """The picture [3,S,S] on a colour [3], or another image [3,S,S] or mask [S,S] in the place of the own one."""
        image, mask = self.image if image is None else image, self.mask if mask is None else mask
        return image * mask + background[:, None, None] * (1 - mask)

    def jitter(self, random: np.random.Generator) -> None:
        """Crop at random; the camera follows."""
        size = self.mask.shape[-1]
        side = size * random.uniform(*_ZOOM)
        x, y = ((size - side) / 2 + size * random.uniform(-_SHIFT, _SHIFT) for _ in range(2))
        self.crop((x, y, side))

    def crop(self, square: tuple[float, float, float]) -> None:
        """Cut out a square (x0, y0, side) in pixels, which may reach outside, at the same size; the camera follows."""
        x, y, side = square
        size = self.mask.shape[-1]
        place = (torch.arange(size) + 0.5) / size * side
        grid = torch.stack(torch.meshgrid(place + x, place + y, indexing="xy"), -1)[None] / size * 2 - 1
        # Nobody is known to be outside, but colours go on, as they do beyond the person's edge.
        self.image = functional.grid_sample(self.image[None], grid, align_corners=False, padding_mode="border")[0]
        self.mask = functional.grid_sample(self.mask[None, None], grid, align_corners=False)[0, 0]
        if self.uv is not None:
            known = torch.where(torch.isfinite(self.uv), self.uv, -9.0)[None]
            picked = functional.grid_sample(known, grid, mode="nearest", align_corners=False, padding_mode="zeros")[0]
            outside = (grid[0].abs() > 1).any(-1)
            self.uv = torch.where((picked < 0) | outside, torch.nan, picked)
        K = self.camera.K.clone()
        K[:2, 2] -= torch.tensor([x, y])
        K[:2] *= size / side
        self.camera = Camera(self.camera.viewmat, K, size, size)


def _whole(sample: Sample) -> Square:
    """The square around the centre of a sample that holds all of it."""
    height, width = sample.mask.shape
    side = max(height, width)
    return -((side - width) // 2), -((side - height) // 2), side


def _squared(sample: Sample, square: Square) -> dict[str, Any]:
    """Image, mask, camera and `uv` (NaN where unknown) of a square of a sample; nobody is seen outside the sample."""
    x0, y0, side = square
    height, width = sample.mask.shape
    pad = (-x0, x0 + side - width, -y0, y0 + side - height)  # negative sides are cut off
    K = sample.camera.K.clone()
    K[:2, 2] -= torch.tensor([float(x0), float(y0)])
    result: dict[str, Any] = {
        "image": functional.pad(sample.image, pad),
        "mask": functional.pad(sample.mask, pad),
        "camera": Camera(sample.camera.viewmat, K, side, side),
    }
    if sample.uv is not None and sample.uv_valid is not None:
        uv = torch.where(sample.uv_valid[..., None], sample.uv, torch.nan).permute(2, 0, 1)
        result["uv"] = functional.pad(uv, pad, value=torch.nan)
    return result


def _foreground(image: Tensor, mask: Tensor) -> Tensor:
    """The person's own colours [3,H,W]: pixels mixed with the backdrop take those of their neighbours inside."""
    share = (mask >= SOLID).float()[None]
    colour = image * share
    for _ in range(_REACH):
        spread = functional.avg_pool2d(torch.cat((colour * share, share))[None], 3, 1, 1)[0]
        mean = spread[:3] / spread[3:].clamp_min(1e-6)
        new = (share == 0) & (spread[3:] > 0)
        colour = torch.where(new, mean, colour)
        share = torch.where(new, 1.0, share)
    return torch.where(share > 0, colour, image)
