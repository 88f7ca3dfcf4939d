"""Mouth shapes of speech as ARKit activations: from sounds in time, or from a recording's spectrum alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uika.head.actions import ARKIT_ACTIONS
from uika.motion.alignment import Phone
from uika.motion.sound_features import HOP, Features

Array = NDArray[np.float64]

# Visemes by the names of the Oculus set, which openfacefx blends; a name without side stands for both sides.
_SHAPES: dict[str, Mapping[str, float]] = {
    "sil": {},
    "PP": {"mouthPress": 0.45, "mouthRollLower": 0.3, "mouthRollUpper": 0.25},
    "FF": {"jawOpen": 0.08, "mouthRollLower": 0.5, "mouthUpperUp": 0.3},
    "TH": {"jawOpen": 0.16, "tongueOut": 0.35, "mouthLowerDown": 0.2, "mouthUpperUp": 0.12},
    "DD": {"jawOpen": 0.16, "mouthLowerDown": 0.2, "mouthUpperUp": 0.1},
    "kk": {"jawOpen": 0.2, "mouthLowerDown": 0.15, "mouthUpperUp": 0.1},
    "CH": {"jawOpen": 0.1, "mouthFunnel": 0.6, "mouthPucker": 0.15},
    "SS": {"jawOpen": 0.06, "mouthStretch": 0.25, "mouthUpperUp": 0.22, "mouthLowerDown": 0.3},
    "nn": {"jawOpen": 0.14, "mouthLowerDown": 0.15, "mouthUpperUp": 0.08},
    "RR": {"jawOpen": 0.16, "mouthFunnel": 0.35, "mouthPucker": 0.2},
    "aa": {"jawOpen": 0.48, "mouthLowerDown": 0.25, "mouthUpperUp": 0.15},
    "E": {"jawOpen": 0.27, "mouthStretch": 0.25, "mouthSmile": 0.15, "mouthUpperUp": 0.18, "mouthLowerDown": 0.15},
    "I": {"jawOpen": 0.13, "mouthStretch": 0.4, "mouthSmile": 0.25, "mouthUpperUp": 0.22, "mouthLowerDown": 0.2},
    "O": {"jawOpen": 0.34, "mouthFunnel": 0.5, "mouthPucker": 0.15},
    "U": {"jawOpen": 0.12, "mouthPucker": 0.6, "mouthFunnel": 0.3},
}
# Sounds that openfacefx's table of IPA lacks, and the neutral vowel, which it opens as wide as "a".
_ALIKE = {"ə": "ɛ", "ᵻ": "ɪ", "ʂ": "ʃ", "ʐ": "ʒ", "β": "v"}
_LIPS_SOFT = 0.025  # seconds, standard deviation: lips do not jump
_CLOSED_BELOW, _DIP = 0.55, 0.25  # of the envelope: a short dip this deep is taken for a stop
_STOP_REACH = 0.12  # seconds


def action_row(actions: Mapping[str, float]) -> Array:
    """Activations [52] in the order of `ARKIT_ACTIONS`; a name without Left or Right moves both sides."""
    row = np.zeros(len(ARKIT_ACTIONS))
    for name, amount in actions.items():
        for full in (name, f"{name}Left", f"{name}Right"):
            if full in ARKIT_ACTIONS:
                row[ARKIT_ACTIONS.index(full)] = amount
    return row


def from_phones(phones: list[Phone], fps: float, count: int, loudness: Array) -> Array:
    """Activations [count,52] of sounds in time, blended into each other by openfacefx (Cohen and Massaro, 1993).

    Args:
        phones: the sounds, without holes, from 0 on.
        fps: frames per second.
        count: frames.
        loudness: [count] in [0,1]; loud vowels open the jaw wider.
    """
    from openfacefx import IPA_MAPPING, VISEMES, PhonemeSegment, build_viseme_curves

    segments = [PhonemeSegment(_ALIKE.get(p.symbol, p.symbol), p.start, p.end) for p in phones]
    _, blend = build_viseme_curves(segments, fps=fps, mapping=IPA_MAPPING)
    weights = np.zeros((count, len(VISEMES)))
    weights[: min(count, len(blend))] = blend[:count]
    actions = weights @ np.stack([action_row(_SHAPES[name]) for name in VISEMES])
    actions[:, ARKIT_ACTIONS.index("jawOpen")] *= 0.6 + 0.6 * loudness
    return actions


def from_sound(heard: Features, fps: float, count: int) -> Array:
    """Activations [count,52] from loudness and spectrum, for recordings in any language without a transcript.

    Loud frames with energy at the first formant of open vowels open the jaw; a high second formant spreads the lips,
    a low one rounds them, both relative to the speaker's own middle; hiss shows the teeth; short dips between loud
    frames close the lips.
    """
    envelope = heard.envelope
    voiced = envelope * _rise(-heard.hiss, 0, 4)
    usual = np.median(heard.front[voiced > 0.5]) if (voiced > 0.5).any() else 0.0
    spread, rounded = _rise(heard.front - usual, 4, 3), _rise(usual - heard.front, 4, 3)
    hiss = envelope * _rise(heard.hiss, 4, 3)
    reach = round(_STOP_REACH / HOP)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(envelope, reach), 2 * reach + 1)
    both_sides = np.minimum(around[:, :reach].max(1), around[:, reach + 1 :].max(1))
    stop = _rise(both_sides - envelope, _DIP, 0.05) * (envelope < _CLOSED_BELOW)
    shapes = {
        "aa": voiced**1.5 * (0.35 + 0.65 * heard.open) * (1 - 0.4 * rounded),
        "I": voiced * spread * (1 - heard.open) * 0.8,
        "U": voiced * rounded * (1 - 0.5 * heard.open) * 0.8,
        "SS": hiss,
        "PP": stop,
    }
    actions = sum(weight[:, None] * action_row(_SHAPES[name]) for name, weight in shapes.items())
    return at_frames(_softened(np.asarray(actions), _LIPS_SOFT / HOP), fps, count)


def at_frames(values: Array, fps: float, count: int) -> Array:
    """Values [T,...] of the features' frames at `count` frames of a film, interpolated linearly."""
    place = (np.arange(count) / fps / HOP).clip(0, len(values) - 1)
    low = np.floor(place).astype(int)
    share = (place - low).reshape(-1, *(1,) * (values.ndim - 1))
    return values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share


def _softened(values: Array, deviation: float) -> Array:
    """Smoothed along the first axis by a Gaussian, `deviation` in rows."""
    reach = int(np.ceil(3 * deviation))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, len(kernel), axis=0)
    return windows @ (kernel / kernel.sum())


def _rise(values: Array, middle: float, width: float) -> Array:
    """From 0 to 1 around `middle`."""
    return 1 / (1 + np.exp(-np.clip((values - middle) / width, -30, 30)))
