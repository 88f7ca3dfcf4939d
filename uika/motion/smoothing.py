"""Smooth motions in time without delaying them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from uika.motion.motion import Motion

MIN_CUTOFF = 5.0  # hertz: what moves slower is noise unless it moves far
SPEED_GAIN = {  # how much faster things may pass, hertz per unit and second
    "expression": 10.0,
    "rotation": 20.0,
    "neck": 20.0,
    "jaw": 20.0,
    "eyes": 20.0,
    "translation": 60.0,
}
_Number = TypeVar("_Number", float, Tensor)
_SPEED_CUTOFF = 1.0  # hertz, of the speed estimate


class OneEuro:
    """The 1-euro filter (Casiez et al., CHI 2012): a low pass whose cutoff rises with the speed of the signal."""

    def __init__(self, value: Tensor, min_cutoff: float, gain: float) -> None:
        """Start at a value [...]; `min_cutoff` in hertz at rest, `gain` in hertz per unit and second of speed."""
        self._kept, self._speed = value, torch.zeros_like(value)
        self._min_cutoff, self._gain = min_cutoff, gain

    def step(self, value: Tensor, seconds: float) -> Tensor:
        """The smoothed value [...], `seconds` after the one before."""
        change = (value - self._kept) / seconds
        self._speed = self._speed + _share(_SPEED_CUTOFF, seconds) * (change - self._speed)
        cutoff = self._min_cutoff + self._gain * self._speed.abs()
        self._kept = self._kept + _share(cutoff, seconds) * (value - self._kept)
        return self._kept


def one_euro(values: Tensor, fps: float, min_cutoff: float, gain: float) -> Tensor:
    """Samples [T,...] at `fps` per second through a `OneEuro`, forwards."""
    smooth = OneEuro(values[0], min_cutoff, gain)
    return torch.stack([values[0], *(smooth.step(value, 1 / fps) for value in values[1:])])


def smoothed(motion: Motion, min_cutoff: float = MIN_CUTOFF) -> Motion:
    """The motion without jitter: the 1-euro filter run forwards and backwards, so that nothing comes late.

    Args:
        motion: any motion.
        min_cutoff: hertz; lower is smoother, infinity changes nothing.

    Raises:
        ValueError: `min_cutoff` is not positive.
    """
    if not min_cutoff > 0:
        raise ValueError(f"min_cutoff must be more than 0 hertz, not {min_cutoff}")
    if math.isinf(min_cutoff):
        return motion
    changed: dict[str, Any] = {}
    for name, gain in SPEED_GAIN.items():
        values = getattr(motion, name)
        ahead = one_euro(values, motion.fps, min_cutoff, gain)
        back = one_euro(values.flip(0), motion.fps, min_cutoff, gain).flip(0)
        changed[name] = (ahead + back) / 2
    return replace(motion, **changed)


def _share(cutoff: _Number, seconds: float) -> _Number:
    return 1 / (1 + 1 / (2 * math.pi * cutoff * seconds))
