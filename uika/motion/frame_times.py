"""Frames that were not taken at an even pace: the rate they mean, and their values at that rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

UNEVEN = 0.25  # of a step: closer to the even grid than this is rounding of the file's times
MAX_FRAMES = 100_000
_LOWEST, _HIGHEST = 0.5, 240.0  # frames per second
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # seconds
_NEAR = 3e-3  # rates this close to a common one are that one
_SHORT, _NOT_RARE = 0.1, 0.25  # place of a short step among all, and the least share of steps as short
_ROUNDING = 0.1  # of a step, between steps and multiples of the shortest
_NTSC = 1000 / 1001

Times = NDArray[np.float64]


def in_seconds(times: Times) -> Times:
    """Times [T] of an unnamed unit in seconds from the first: the unit is the largest that makes a camera's rate.

    Raises:
        ValueError: they do not rise.
    """
    steps = np.diff(times)
    if not np.isfinite(times).all() or (steps < 0).any() or not (steps > 0).any():
        raise ValueError("its times do not rise from frame to frame")
    usual = float(np.median(steps[steps > 0]))
    unit = next((unit for unit in _UNITS if _LOWEST <= 1 / (usual * unit) <= _HIGHEST), 1.0)
    return (times - times[0]) * unit


def rate_of(seconds: Times) -> float:
    """Frames per second that rising times [T] mean.

    Of uneven ones the rate at which frames were lost, if all steps are multiples of one that is not rare, else the rate
    between most neighbours.
    """
    steps = np.diff(seconds)
    mean = float(seconds[-1] - seconds[0]) / len(steps)
    if not is_even(seconds, 1 / mean):
        steps = steps[steps > 0]
        short = steps[steps < 1.5 * np.quantile(steps, _SHORT)].mean()
        multiples = steps / short
        whole = multiples.round()
        if (np.abs(multiples - whole) < _ROUNDING).all() and (whole == 1).mean() >= _NOT_RARE:
            mean = float(steps.sum() / whole.sum())
        else:
            mean = float(np.median(steps))
    return _common(1 / mean)


def is_even(seconds: Times, fps: float) -> bool:
    """Whether times [T] are those of frames at a steady rate, up to rounding."""
    return bool((np.abs(seconds - seconds[0] - np.arange(len(seconds)) / fps) * fps < UNEVEN).all())


def even_places(seconds: Times, fps: float) -> Times:
    """Where, between the frames taken at `seconds` [T], the frames of a steady rate lie: [S] in 0 to T - 1.

    Raises:
        ValueError: there would be more frames than a motion may have.
    """
    count = round(float(seconds[-1] - seconds[0]) * fps) + 1
    if count > MAX_FRAMES:
        raise ValueError(f"its times span {count:,} frames; {MAX_FRAMES:,} are the most")
    return np.interp(np.arange(count) / fps, seconds - seconds[0], np.arange(len(seconds)))


def resampled(values: NDArray[np.float64], places: Times) -> NDArray[np.float64]:
    """Rows of values [T,C] at `places` [S] between them, interpolated linearly."""
    before = np.floor(places).astype(int)
    after = np.minimum(before + 1, len(values) - 1)
    share = (places - before)[:, None]
    return (1 - share) * values[before] + share * values[after]


def _common(rate: float) -> float:
    whole = max(round(rate), 1)
    near = min((whole, whole * _NTSC), key=lambda other: abs(other - rate))
    return near if abs(near / rate - 1) < _NEAR else rate
