"""What a recording of speech sounds like from one hundredth of a second to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uika.io.sound import Sound
from uika.motion.motion import MotionError

HOP = 0.01  # seconds between frames
_WINDOW = 0.025  # seconds
_PIECE = 4096  # frames transformed at once
_FLOOR = 1e-10  # power
_SILENT = 1e-8  # power of the loudest frame below which a recording counts as silent (-80 dB)
# Hertz: voice, first formant, second formant of rounded and of spread vowels, hiss.
_BANDS = {"voice": (80, 1000), "open": (450, 1000), "back": (500, 1300), "front": (1700, 3200), "hiss": (3500, 8000)}


@dataclass(frozen=True, eq=False)
class Features:
    """Frames of `HOP` seconds; decibels are relative to the recording's loud frames or between bands."""

    loudness: NDArray[np.float64]  # [T] dB, 0 is the 95th percentile
    hiss: NDArray[np.float64]  # [T] dB above 3.5 kHz relative to the voice
    front: NDArray[np.float64]  # [T] dB of the spread vowels' second formant relative to the rounded ones'
    open: NDArray[np.float64]  # [T] share in [0,1] of the voice that lies where open vowels have their first formant

    @property
    def envelope(self) -> NDArray[np.float64]:
        """Loudness in [0,1] [T]: 0 at 40 dB below loud frames."""
        return np.clip(1 + self.loudness / 40, 0, 1)


def features(sound: Sound) -> Features:
    """Loudness and spectral shape of a recording.

    Raises:
        MotionError: it is shorter than a tenth of a second, or silent.
    """
    width, hop = round(_WINDOW * sound.rate), round(HOP * sound.rate)
    if sound.seconds < 0.1:
        raise MotionError(f"the recording is {sound.seconds:.2f} s long, too short for speech")
    # Frame t looks at the window around t * HOP.
    padded = np.pad(sound.samples, (width // 2, width))
    frames = np.lib.stride_tricks.sliding_window_view(padded, width)[: len(sound.samples) : hop]
    window = np.hanning(width)
    frequency = np.fft.rfftfreq(width, 1 / sound.rate)
    masks = np.stack([(frequency >= low) & (frequency < high) for low, high in _BANDS.values()], -1)
    pieces = []
    for start in range(0, len(frames), _PIECE):  # a whole recording's spectra would not fit in memory
        power = np.abs(np.fft.rfft(frames[start : start + _PIECE] * window)) ** 2 / (window.sum() * width)
        pieces.append(np.concatenate((power @ masks, power.sum(1, keepdims=True)), 1))
    table = np.concatenate(pieces) + _FLOOR
    bands = dict(zip((*_BANDS, "all"), table.T, strict=True))
    loud = np.percentile(bands["all"], 95)
    if bands["all"].max() < _SILENT:
        raise MotionError("the recording is silent")

    def decibels(one: str, other: str) -> NDArray[np.float64]:
        return 10 * np.log10(bands[one] / bands[other])

    return Features(
        loudness=10 * np.log10(bands["all"] / loud),
        hiss=decibels("hiss", "voice"),
        front=decibels("front", "back"),
        open=bands["open"] / bands["voice"],
    )
