"""Smooth motions in time without delaying them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

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
_SPEED_CUTOFF = 1.0  # hertz, of the speed estimate


def one_euro(values: Tensor, fps: float, min_cutoff: float, gain: float) -> Tensor:
    """The 1-euro filter (Casiez et al., CHI 2012): a low pass whose cutoff rises with the speed of the signal.

    Args:
        values: [T,...] samples.
        fps: samples per second.
        min_cutoff: hertz at rest.
        gain: hertz per unit and second of speed.
    """
    result = torch.empty_like(values)
    result[0] = kept = values[0]
    speed = torch.zeros_like(kept)
    slow = _share(_SPEED_CUTOFF, fps)
    for index in range(1, len(values)):
        speed = speed + slow * ((values[index] - kept) * fps - speed)
        cutoff = min_cutoff + gain * speed.abs()
        kept = kept + (1 / (1 + fps / (2 * math.pi * cutoff))) * (values[index] - kept)
        result[index] = kept
    return result


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


def _share(cutoff: float, fps: float) -> float:
    return 1 / (1 + fps / (2 * math.pi * cutoff))
