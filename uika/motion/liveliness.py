"""What a face does beside speaking: blinks, brows, glances and small movements of the head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uika.motion.mouth_shapes import action_row

Array = NDArray[np.float64]

_BLINK_EVERY = (2.2, 4.5)  # seconds; people who talk blink about 20 times a minute
_BLINK_WIDTH = 0.075  # seconds
_GLANCE_EVERY = (0.8, 2.4)  # seconds
_GLANCE = (0.09, 0.035)  # radians to a side, up or down
_SACCADE = 0.05  # seconds
_SWAY = (0.035, 0.05, 0.022)  # radians: nod, turn, tilt
_STRESS_NOD = 0.04  # radians
_EASE = 0.4  # seconds at both ends, from and to rest
_SLOW = 0.25  # seconds over which loudness moves brows and head


@dataclass(frozen=True, eq=False)
class Liveliness:
    """T frames."""

    actions: Array  # [T,52] to be added to the mouth's
    neck: Array  # [T,3] axis-angle, radians
    eyes: Array  # [T,6]


def liveliness(loudness: Array, fps: float, seed: int = 0) -> Liveliness:
    """Movement that goes with speech; it starts and ends at rest.

    Args:
        loudness: [T] in [0,1]; stressed syllables raise the brows and nod the head.
        fps: frames per second.
        seed: of the random blinks and glances.
    """
    random, count = np.random.default_rng(seed), len(loudness)
    time = np.arange(count) / fps
    length = max(count / fps, 1e-6)
    gate = _smooth(time / _EASE) * _smooth((length - time) / _EASE)
    width = max(1, round(_SLOW * fps))
    slow = np.convolve(loudness, np.ones(width) / width, "same")
    stress = np.clip((slow - np.median(slow)) * 2, 0, 1) * gate
    shut = np.zeros(count)
    for at in _moments(random, _BLINK_EVERY, length - 0.15):
        shut = np.maximum(shut, np.exp(-(((time - at) / _BLINK_WIDTH) ** 2)))
    actions = stress[:, None] * action_row({"browInnerUp": 0.3, "browOuterUp": 0.2})
    actions += shut[:, None] * action_row({"eyeBlink": 1.0})
    waves = random.uniform(0.13, 0.45, (3, 3, 1)), random.uniform(0, 2 * np.pi, (3, 3, 1))
    sway = np.sin(2 * np.pi * waves[0] * time + waves[1]).mean(1).T * np.array(_SWAY)
    neck = gate[:, None] * sway
    neck[:, 0] += _STRESS_NOD * stress
    return Liveliness(actions, neck, _glances(random, time, length, gate))


def _glances(random: np.random.Generator, time: Array, length: float, gate: Array) -> Array:
    """Both eyes [T,6] jump together from one place to the next."""
    gaze, before = np.zeros((len(time), 2)), np.zeros(2)
    for at in _moments(random, _GLANCE_EVERY, length):
        # Every other glance returns to the listener.
        target = np.zeros(2) if before.any() else random.uniform(-1, 1, 2) * _GLANCE
        gaze += _smooth((time - at) / _SACCADE)[:, None] * (target - before)
        before = target
    one = np.stack((gaze[:, 1], gaze[:, 0], np.zeros(len(time))), -1) * gate[:, None]
    return np.concatenate((one, one), -1)


def _moments(random: np.random.Generator, every: tuple[float, float], end: float) -> list[float]:
    moments, at = [], random.uniform(0.4, every[1] / 2)
    while at < end:
        moments.append(at)
        at += random.uniform(*every)
    return moments


def _smooth(share: Array) -> Array:
    share = np.clip(share, 0, 1)
    return share * share * (3 - 2 * share)
