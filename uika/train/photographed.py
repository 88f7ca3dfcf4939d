"""Photos on their way to an item exactly as in use: a file, the detector, the mattes, the fit, one light for all."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.canonical.light import relative_lights, sample_light, under_reference
from uika.data.views import View
from uika.errors import UikaWarning
from uika.head import HeadModel
from uika.photo import PhotoError, head_matte, prepare
from uika.reconstruction import PreparedPhoto, fit_prepared
from uika.train.augment import Grade, degrade
from uika.train.sources import Sources, located

_TIGHT = 0.15  # odds of a photo that is cut close
_CUT = (0.22, 0.12)  # most of the person's height and width that such a cut takes away


@dataclass(frozen=True, eq=False)
class Photographed:
    """A view's photo as the program prepares it, and the view in the same crop, clean."""

    prepared: PreparedPhoto
    view: View


def photograph(view: View, shared: Grade, own: Grade, random: np.random.Generator | None) -> Photographed | None:
    """Take a photo of a view before its backdrop, spoil it as cameras and files do, and prepare it.

    Args:
        view: of a sample with a backdrop; stays as it is.
        shared: grade of all photos and pictures of the person.
        own: grade of this photo after it.
        random: decides on crop and degradation; None for a photo that is as good as the view.

    Returns:
        The photo, or None where the detector finds no face.
    """
    sample, size = view.sample, view.mask.shape[-1]
    left, top = _cut(sample.mask, random) if random is not None and random.random() < _TIGHT else (0, 0)
    height, width = sample.mask.shape
    picture = own(shared(sample.image[:, top:, left : width - left]))
    if random is not None:
        picture = degrade(picture, random)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UikaWarning)  # made-up people may look like nobody
        path = Path(folder) / "photo.png"
        _save(picture, path)
        try:
            photo = prepare(path, size)
        except PhotoError:
            return None
        prepared = PreparedPhoto(photo, head_matte(photo))
    x0, y0, side = photo.crop
    whole = max(height, width)
    clean = View(sample, whole)  # a square around the whole sample
    clean.image = shared(clean.image)
    clean.crop((x0 + left + (whole - width) // 2, y0 + top + (whole - height) // 2, side))
    return Photographed(prepared, _resized(clean, size))


def photographed_sources(photos: Sequence[Photographed], head: HeadModel) -> Sources:
    """Fit the head to photos and find what their pixels show, as `uika.reconstruct` does."""
    by_file = {each.prepared.photo.sha256: each.view for each in photos}
    found = fit_prepared([each.prepared for each in photos], head)
    fit = found.fit
    assert fit is not None
    uv, weight = located(fit, head, found.mattes)
    sample = sample_light(head, fit.parameters.identity[0], fit.static_offset, found.images, uv, weight[:, None])
    lights = relative_lights(sample, int(fit.cameras.viewmat[:, 2, 2].argmin()))
    images = under_reference(found.images, uv, sample, lights)
    return Sources([by_file[digest] for digest in found.digests], fit, images, found.mattes, uv, weight, exact=False)


def _cut(mask: Tensor, random: np.random.Generator) -> tuple[int, int]:
    """Columns on both sides and rows above that a tight crop takes away."""
    rows, columns = (torch.nonzero(mask.amax(axis) > 0.5)[:, 0] for axis in (1, 0))
    if not len(rows) or not len(columns):
        return 0, 0
    high, wide = int(rows[-1] - rows[0]), int(columns[-1] - columns[0])
    top = int(rows[0]) + int(random.uniform(0, _CUT[0]) * high)
    side = min(int(columns[0]), mask.shape[1] - 1 - int(columns[-1])) + int(random.uniform(0, _CUT[1]) * wide)
    return max(0, min(side, mask.shape[1] // 3)), max(0, min(top, mask.shape[0] // 3))


def _resized(view: View, size: int) -> View:
    """The view with another number of pixels."""
    planes = torch.cat((view.image, view.mask[None]))[None]
    planes = torch.nn.functional.interpolate(planes, size=(size, size), mode="bilinear", antialias=True)[0]
    view.image, view.mask, view.uv = planes[:3], planes[3], None
    view.camera = view.camera.resized(size, size)
    return view


def _save(picture: Tensor, path: Path) -> None:
    from PIL import Image

    pixels = (picture.clamp(0, 1).permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).save(path, compress_level=1)
