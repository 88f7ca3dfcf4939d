"""Speech without a voice: vowels as harmonics under two formants, hiss as noise, and files of them."""

import struct
from pathlib import Path

import numpy as np

from uika.io.sound import RATE, Sound

FORMANTS = {"a": (750, 1300), "i": (300, 2400), "u": (320, 800), "m": (250, 1100)}
# Something like a sentence of five words.
SENTENCE = [("_", 0.2), ("a", 0.15), ("m", 0.1), ("u", 0.2), ("_", 0.2), ("m", 0.1), ("a", 0.2), ("s", 0.15)]
SENTENCE += [("u", 0.15), ("m", 0.1), ("i", 0.2), ("u", 0.2), ("_", 0.2)]
_GAIN = {"m": 0.3}


def spoken(parts: list[tuple[str, float]], rate: int = RATE) -> Sound:
    """Sounds in order with their seconds: "a", "i", "u", "m", "s" and "_" for silence."""
    noise = np.random.default_rng(0)
    pieces = []
    for name, seconds in parts:
        time = np.arange(round(seconds * rate)) / rate
        if name == "s":
            wave = np.diff(noise.normal(0, 0.06, len(time) + 1))  # louder towards high frequencies
        elif name == "_":
            wave = noise.normal(0, 1e-5, len(time))
        else:
            wave = np.zeros(len(time))
            for harmonic in range(120, 4000, 120):
                level = sum(1 / (1 + ((harmonic - f) / 90) ** 2) for f in FORMANTS[name])
                wave += 0.15 * _GAIN.get(name, 1) * level * np.sin(2 * np.pi * harmonic * time)
        ramp = np.clip(np.minimum(time, seconds - time) / 0.01, 0, 1)
        pieces.append(wave * ramp)
    return Sound(np.concatenate(pieces).astype(np.float32).clip(-1, 1), rate)


def write_wav(path: Path, samples: np.ndarray, rate: int = RATE, channels: int = 1, bits: int = 16) -> Path:
    """Samples [N] or [N,channels] in [-1,1] as PCM."""
    frames = samples if samples.ndim == 2 else np.repeat(samples[:, None], channels, 1)
    if bits == 8:
        data = (frames * 127 + 128).clip(0, 255).astype(np.uint8).tobytes()
    else:
        data = (frames * 32767).astype("<i2").tobytes()
    step = channels * bits // 8
    kind = struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, channels, rate, rate * step, step, bits)
    head = kind + struct.pack("<4sI", b"data", len(data))
    path.write_bytes(struct.pack("<4sI4s", b"RIFF", 4 + len(head) + len(data), b"WAVE") + head + data)
    return path
