"""An invisible mark in rendered pictures: a fixed, tiled pattern of middle frequencies added to the luma.

The pattern is the same for everybody and not secret, so that anybody can look for it; it says that a picture was
rendered, and resists ordinary handling, not an adversary who subtracts it.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

TILE = 128  # pixels after which the pattern repeats
STRENGTH = 1.4  # root mean square over a picture in steps of 8 bits: at least 45.2 dB
THRESHOLD = 6.5  # standard deviations; chance reaches it in fewer than one of 100,000 pictures
MIN_SIZE = 96  # pixels of a side, below which there is too little to look at
SCALES = (1.0, 0.5, 2.0, 0.75, 1.5, 2 / 3, 4 / 3, 0.8, 1.25)  # of the picture over the rendered one
_MOST = 2.1  # steps, root mean square where a picture has detail and is flat elsewhere
_LOWEST, _HIGHEST = 4, 26  # periods in a tile
_SEED = b"uika-drjit watermark 2"
_LUMA = (0.299, 0.587, 0.114)
_FINE, _COARSE = 3, 33  # pixels: the windows whose means bound the band that is looked at
_QUIET = 0.01  # steps: what is left of a flat picture by rounding
_NOISE = 2.0  # squared steps that a picture's own detail is held against
_BLOCK = 8  # pixels, of the blocks whose detail is measured
_FLAT, _BUSY = 0.35, 2.5  # steps, standard deviation in a block: the mark is left out below, and whole above
_MAX_SIDE = 1536  # pixels that are looked at, from the middle


@dataclass(frozen=True)
class Detection:
    """What was found of the mark."""

    score: float  # standard deviations above chance
    scale: float  # size of the picture over that of the rendered one, at the best score
    frames: int  # pictures that were looked at together

    @property
    def found(self) -> bool:
        """Whether the mark is there."""
        return self.score >= THRESHOLD


@overload
def mark(picture: Tensor) -> Tensor: ...
@overload
def mark(picture: NDArray[np.uint8]) -> NDArray[np.uint8]: ...
def mark(picture: Tensor | NDArray[np.uint8]) -> Tensor | NDArray[np.uint8]:
    """Add the mark to a picture [H,W,3], floats in [0,1] or bytes; values are clipped to that range.

    What is flat stays as it is: there the eye would see the mark (`strength`).
    """
    height, width = picture.shape[:2]
    if isinstance(picture, np.ndarray):
        shown = torch.from_numpy(np.ascontiguousarray(picture))
        steps = (strength(shown[..., 1].float()) * _plane(height, width)).round_().to(torch.int16)
        sums = shown.to(torch.int16).add_(steps[..., None].expand(-1, -1, 3).contiguous())
        return sums.clamp_(0, 255).to(torch.uint8).numpy()
    gain = strength(255 * picture[..., 1].detach().float())
    return (picture + (gain[..., None] * pattern(height, width)).to(picture)).clamp_(0, 1)


def strength(green: Tensor) -> Tensor:
    """The mark's local root mean square [H,W] in steps of 8 bits, from the picture's green channel [H,W] in such steps.

    Detail hides the mark (Legge and Foley, 1980), so it follows the standard deviation in blocks; a block with a flat
    neighbour bears nothing, so that no seam lies around what is flat. What is saved there may be spent elsewhere.
    """
    height, width = green.shape
    planes = pad(green[None, None], (0, -width % _BLOCK, 0, -height % _BLOCK), mode="replicate")
    mean, square = avg_pool2d(planes, _BLOCK), avg_pool2d(planes.square(), _BLOCK)
    detail = (square - mean.square()).clamp_min(0).sqrt()
    share = ((detail - _FLAT) / (_BUSY - _FLAT)).clamp(0, 1)
    share = -max_pool2d(-pad(share, (1, 1, 1, 1), mode="replicate"), 3, 1)
    full = interpolate(share, planes.shape[-2:], mode="bilinear", align_corners=False)
    # What is even within a block of detail, such as the background beside an ear, bears nothing either.
    shape = torch.where(_uneven(green), full[0, 0, :height, :width], 0.0)
    level = float(shape.square().mean().sqrt())
    return shape * min(_MOST, STRENGTH / max(level, 1e-6))


def _uneven(green: Tensor) -> Tensor:
    """Which pixels [H,W] differ by a step from one beside them, above or below."""
    across, down = ((green.diff(dim=dim)).abs() >= 1 for dim in (1, 0))
    result = torch.zeros_like(green, dtype=torch.bool)
    result[:, 1:] |= across
    result[:, :-1] |= across
    result[1:] |= down
    result[:-1] |= down
    return result


@lru_cache(maxsize=4)
def pattern(height: int, width: int) -> Tensor:
    """The mark [H,W,3], the same in every channel, for pictures in [0,1]; root mean square: one step of 8 bits."""
    tile = torch.fft.ifft2(_spectrum()).real
    tile = tile / tile.square().mean().sqrt() / 255
    repeats = (math.ceil(height / TILE), math.ceil(width / TILE))
    return tile.repeat(*repeats)[:height, :width].float()[..., None].repeat(1, 1, 3)


@lru_cache(maxsize=4)
def _plane(height: int, width: int) -> Tensor:
    """One channel of the mark [H,W] in steps of 8-bit pictures."""
    return (pattern(height, width)[..., 0] * 255).contiguous()


def detect(pictures: Iterable[Tensor], scales: tuple[float, ...] = SCALES) -> Detection:
    """Look for the mark in pictures [H,W,3] of one size in [0,1], all together.

    Args:
        pictures: one picture, or some frames of one video.
        scales: resizings to allow for, tried until one shows the mark.

    Returns:
        The best score over the scales that were tried and all shifts; 0 if the pictures are too small or empty.
    """
    lumas = [picture.float() @ torch.tensor(_LUMA) * 255 for picture in pictures]
    best = Detection(0.0, 1.0, len(lumas))
    for scale in scales:
        tile = torch.zeros(TILE, TILE)
        for luma in lumas:
            tile += _folded(luma, scale)
        score = _score(tile)
        if score > best.score:
            best = Detection(score, scale, len(lumas))
        if best.found:
            break
    return best


@lru_cache(maxsize=1)
def _spectrum() -> Tensor:
    """[TILE,TILE] complex: unit amplitude and a fixed phase on a ring of frequencies, zero elsewhere."""
    frequency = torch.fft.fftfreq(TILE, 1 / TILE)
    y, x = torch.meshgrid(frequency, frequency, indexing="ij")
    radius = torch.hypot(x, y)
    half = (radius >= _LOWEST) & (radius <= _HIGHEST) & ((y > 0) | ((y == 0) & (x > 0)))
    places = half.nonzero()
    digest = hashlib.shake_256(_SEED).digest(2 * len(places))
    phase = torch.from_numpy(np.frombuffer(digest, "<u2").astype(np.float64)) / 65536 * 2 * math.pi
    spectrum = torch.zeros(TILE, TILE, dtype=torch.complex128)
    values = torch.polar(torch.ones_like(phase), phase)
    spectrum[places[:, 0], places[:, 1]] = values
    spectrum[-places[:, 0] % TILE, -places[:, 1] % TILE] = values.conj()
    return spectrum


def _folded(luma: Tensor, scale: float) -> Tensor:
    """The sum [TILE,TILE] of all tiles of a picture, brought back to its rendered size and flattened."""
    height, width = (round(side / scale) for side in luma.shape)
    if min(height, width) < MIN_SIZE:
        return torch.zeros(TILE, TILE)
    planes = luma[None, None]
    if scale != 1:
        planes = interpolate(planes, (height, width), mode="bilinear", antialias=True, align_corners=False)
    top, left = (max(0, side - _MAX_SIDE) // 2 for side in (height, width))
    planes = planes[..., top : top + _MAX_SIDE, left : left + _MAX_SIDE]
    band = _mean(planes, _FINE) - _mean(planes, _COARSE)
    # A picture's own detail drowns the mark: it counts less where there is much of it.
    weighed = torch.where(band.abs() < _QUIET, 0, band) / (_mean(band.square(), _COARSE) + _NOISE)
    height, width = weighed.shape[-2:]
    whole = pad(weighed, (0, -width % TILE, 0, -height % TILE))[0, 0]
    return whole.unflatten(0, (-1, TILE)).unflatten(2, (-1, TILE)).sum((0, 2))


def _mean(planes: Tensor, window: int) -> Tensor:
    half = window // 2
    rows = avg_pool2d(planes, (window, 1), 1, (half, 0), count_include_pad=False)
    return avg_pool2d(rows, (1, window), 1, (0, half), count_include_pad=False)


def _score(tile: Tensor) -> float:
    """The highest phase correlation over all shifts, in its standard deviations for random phases."""
    truth = _spectrum()
    ring = truth != 0
    found = torch.fft.fft2(tile.double()) * ring
    size = found.abs()
    level = size[ring].mean()
    if not float(level) > 1e-6:
        return 0.0
    phases = torch.where(size > 1e-6 * level, found / size.clamp_min(1e-30), 0)
    correlation = torch.fft.ifft2(phases * truth.conj()).real * TILE**2
    return float(correlation.max()) / math.sqrt(int(ring.sum()))
