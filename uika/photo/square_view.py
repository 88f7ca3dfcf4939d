"""Square crops of captured images as the released model was trained on them (its training-data loader)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from uika.errors import UikaError

MASK_THRESHOLD = 180  # a stored mask value above it is the person
REFERENCE_THRESHOLD = 0.7
REFERENCE_SCALE = 1.5
_CENTRE_TOLERANCE = 1.25  # pixels of the result


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A square view, composited on one grey."""

    image: Tensor  # [3,S,S] in [0,1]
    mask: Tensor  # [S,S] in [0,1], soft at the edges
    K: Tensor  # [3,3] pixels of the view
    offset: int  # pixels cut from each side of the padded image


def prepare_view(
    image: np.ndarray,
    mask: np.ndarray,
    K: Tensor,
    size: int = 512,
    background: float = 1.0,
    enlarge: float = 1.0,
) -> PreparedView:
    """Composite, pad to a square, crop around the image's centre as far as the person reaches, and resize.

    Args:
        image: [H,W,3] float in [0,1].
        mask: [H,W] bool, True on the person; see `MASK_THRESHOLD`.
        K: [3,3] pixels of the image.
        size: side of the result.
        background: grey level.
        enlarge: factor on the crop, limited by the image; training draws it from 0.8 to 1.2.

    Raises:
        UikaError: the sizes differ, the mask is empty, or the principal point is not near the image's centre.
    """
    if image.shape[:2] != mask.shape:
        raise UikaError(f"the image has {image.shape[:2]} pixels but its mask {mask.shape}; they must agree")
    if not mask.any():
        raise UikaError("the mask is empty; nobody is in the image")
    solid = mask[..., None].astype(np.float32)
    square = _pad(image.astype(np.float32) * solid + background * (1 - solid), background)
    person = _pad(mask.astype(np.float32), 0.0)
    side = len(square)
    shift = torch.tensor([(side - image.shape[1]) // 2, (side - image.shape[0]) // 2], dtype=K.dtype)
    offset = _crop_offset(person, enlarge)
    inner = side - 2 * offset
    cut = slice(offset, side - offset)
    result = K.clone()
    result[:2, 2] += shift - offset
    result[:2] *= size / inner
    if float((result[:2, 2] - size / 2).abs().max()) > _CENTRE_TOLERANCE:
        raise UikaError(f"the principal point lies at {result[:2, 2].tolist()} of {size} pixels; it must be the centre")
    result[:2, 2] = size / 2
    return PreparedView(
        torch.from_numpy(area_resize(square[cut, cut], size)).permute(2, 0, 1).contiguous(),
        torch.from_numpy(area_resize(person[cut, cut], size)),
        result,
        offset,
    )


def reference_box(box: tuple[float, float, float, float], width: int, height: int) -> tuple[int, int, int, int]:
    """The part of a photo that inference uses: a square 1.5 times as large as the detected head, inside the photo.

    Args:
        box: x0, y0, x1, y1 of the head in pixels.
        width: pixels of the photo.
        height: pixels of the photo.

    Returns:
        x0, y0, x1, y1 in whole pixels, the last two exclusive.
    """
    x0, y0, x1, y1 = box
    reach = 0.5 * REFERENCE_SCALE * max(x1 - x0, y1 - y0)
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    left, top = max(math.floor(x - reach), 0), max(math.floor(y - reach), 0)
    return left, top, min(math.ceil(x + reach), width), min(math.ceil(y + reach), height)


def prepare_reference(image: np.ndarray, alpha: np.ndarray, size: int = 512) -> tuple[Tensor, Tensor]:
    """A photo, cut to `reference_box`, as the released model expects it: image [3,S,S] on white and mask [S,S].

    Args:
        image: [H,W,3] float in [0,1].
        alpha: [H,W] person matte in [0,1]; more than 0.7 counts as the person.
        size: side of the result.

    Raises:
        UikaError: the sizes differ, or the matte shows nobody.
    """
    centred = torch.tensor([[1.0, 0.0, image.shape[1] / 2], [0.0, 1.0, image.shape[0] / 2], [0.0, 0.0, 1.0]])
    prepared = prepare_view(image, alpha > REFERENCE_THRESHOLD, centred, size)
    return prepared.image, prepared.mask


def area_resize(image: np.ndarray, size: int) -> np.ndarray:
    """Resize a square image [N,N] or [N,N,C] to [S,S(,C)]: area means when it shrinks, linear when it grows.

    The same weights as OpenCV's `INTER_AREA`.
    """
    weights = _area_weights(len(image), size)
    flat = image.reshape(len(image), -1)
    rows = (weights @ flat).reshape(size, *image.shape[1:])
    turned = np.swapaxes(rows, 0, 1)
    columns = (weights @ turned.reshape(len(turned), -1)).reshape(size, size, *image.shape[2:])
    return np.ascontiguousarray(np.swapaxes(columns, 0, 1), np.float32)


def _area_weights(source: int, target: int) -> np.ndarray:
    """Matrix [T,S] of the share that each source pixel has in each target pixel."""
    scale = source / target
    place = np.arange(target)
    weights = np.zeros((target, source))
    if scale >= 1:
        start, end = place * scale, (place + 1) * scale
        cells = np.arange(source)
        overlap = np.minimum(end[:, None], cells + 1) - np.maximum(start[:, None], cells)
        weights = overlap.clip(0, None)
        return weights / weights.sum(1, keepdims=True)
    # When growing, a target pixel mixes two sources only where it lies across the border between them.
    first = np.floor(place * scale).astype(int)
    share = ((place + 1) - (first + 1) / scale).clip(0, None)
    share -= np.floor(share)
    weights[place, first.clip(0, source - 1)] += 1 - share
    weights[place, (first + 1).clip(0, source - 1)] += share
    return weights


def _pad(image: np.ndarray, value: float) -> np.ndarray:
    side = max(image.shape[:2])
    before = [(side - length) // 2 for length in image.shape[:2]]
    widths = [(b, side - length - b) for b, length in zip(before, image.shape[:2], strict=True)]
    return np.pad(image, widths + [(0, 0)] * (image.ndim - 2), constant_values=value)


def _crop_offset(person: np.ndarray, enlarge: float) -> int:
    """Pixels to cut from each side so that the farthest pixel of the person, times `enlarge`, stays inside."""
    centre = len(person) // 2
    rows, columns = np.nonzero(person > 0)
    reach = max(int(np.abs(places - centre).max()) for places in (rows, columns))
    return max(0, centre - math.ceil(reach * enlarge))
