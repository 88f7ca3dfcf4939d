"""Crops of the portrait that the face models are tried on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from uika.assets import PORTRAIT
from uika.photo.crop import resample

# Side over the portrait's, shift of the centre in pixels, turn in degrees.
_CROPS = ((1.0, 0, 0, 0), (1.0, 6, -4, 4), (0.7, 5, -40, 0), (0.55, 20, -60, 0), (1.3, 0, 0, 0), (0.7, 5, -40, 17))


def portrait_crops(size: int = 512) -> list[NDArray[np.uint8]]:
    """Crops [size,size,3]; the first two are alike, as frames of a video are."""
    portrait = np.asarray(Image.open(PORTRAIT).convert("RGB"))
    middle, crops = len(portrait) / 2, []
    for share, right, down, degrees in _CROPS:
        side = len(portrait) * share
        crop = resample(portrait, (middle - side / 2 + right, middle - side / 2 + down, side), size)
        crops.append(np.asarray(Image.fromarray(crop).rotate(degrees, Image.Resampling.BICUBIC)))
    return crops
