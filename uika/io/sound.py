"""Sound: read from any file that PyAV decodes, and encoded beside a film's pictures."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uika.errors import UikaError
from uika.io.media import open_media

RATE = 48_000  # samples per second
MAX_SECONDS = 600.0
SUFFIXES = (".wav", ".mp3", ".flac", ".ogg", ".opus", ".m4a", ".aac", ".mp4", ".mov", ".webm")
_UNKNOWN_SIZE = 0x7FFF0000  # what programs that write into a pipe put where the size belongs, or more
_BLOCK = 1024  # samples that AAC encodes at once


@dataclass(frozen=True, eq=False)
class Sound:
    """One channel of sound."""

    samples: NDArray[np.float32]  # [N] in [-1,1]
    rate: int = RATE  # samples per second

    @property
    def seconds(self) -> float:
        """Its length."""
        return len(self.samples) / self.rate


def read_sound(path: str | Path) -> Sound:
    """The first sound track of a file (WAV, MP3, FLAC, Ogg, M4A, a video), mixed to one channel at 48 kHz.

    Raises:
        UikaError: the file is missing, no sound, empty, cut short, or longer than ten minutes; it names the file.
    """
    import av

    source = Path(path)
    if not source.is_file():
        raise UikaError(f"{source}: no such sound file")
    _check_whole(source)
    parts: list[NDArray[np.float32]] = []
    seconds = 0.0
    try:
        with open_media(source) as container:
            if not container.streams.audio:
                raise UikaError(f"{source}: holds no sound")
            if (container.duration or 0) / av.time_base > MAX_SECONDS:
                raise _too_long(source)
            resampler = av.AudioResampler(format="fltp", layout="mono", rate=RATE)
            for frame in container.decode(audio=0):
                seconds += frame.samples / max(frame.sample_rate, 1)
                if seconds > MAX_SECONDS:  # known before a frame of one sample a second is blown up
                    raise _too_long(source)
                parts += [part.to_ndarray()[0] for part in resampler.resample(frame)]
            parts += [part.to_ndarray()[0] for part in resampler.resample(None)]
    except UikaError:
        raise
    except (av.FFmpegError, OSError, ValueError) as error:
        raise UikaError(f"{source}: cannot be read as sound ({error})") from error
    samples = np.concatenate(parts, dtype=np.float32) if parts else np.zeros(0, np.float32)
    parts.clear()
    if not len(samples):
        raise UikaError(f"{source}: holds no sound")
    if not np.isfinite(samples).all():
        raise UikaError(f"{source}: holds sound that is not finite")
    return Sound(samples.clip(-1, 1, out=samples))


class SoundTrack:
    """The sound track of an MP4 that is being written; AAC."""

    def __init__(self, container: Any, sound: Sound) -> None:
        """Add the track to an opened container, before anything is written to it."""
        self._container, self._sound, self._sent = container, sound, 0
        self._stream = container.add_stream("aac", rate=sound.rate)
        self._stream.layout = "mono"
        self._stream.bit_rate = 128_000

    def until(self, seconds: float) -> None:
        """Encode what sounds before a time, so that pictures and sound lie side by side in the file."""
        import av

        end = min(len(self._sound.samples), round(seconds * self._sound.rate))
        while self._sent < end:
            block = self._sound.samples[self._sent : min(self._sent + _BLOCK, end)]
            frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(block[None]), format="fltp", layout="mono")
            frame.sample_rate, frame.pts = self._sound.rate, self._sent
            self._container.mux(self._stream.encode(frame))
            self._sent += len(block)

    def finish(self) -> None:
        """Write what the encoder still holds."""
        self._container.mux(self._stream.encode(None))


def _too_long(source: Path) -> UikaError:
    return UikaError(f"{source}: is longer than {MAX_SECONDS / 60:g} minutes; cut it into parts")


def _check_whole(source: Path) -> None:
    """Refuse a WAV file that holds less than its header says: decoders would end early without a word."""
    with source.open("rb") as file:
        head = file.read(12)
        if head[:4] != b"RIFF" or head[8:] != b"WAVE":
            return
        size = source.stat().st_size
        while len(chunk := file.read(8)) == 8:
            name, length = struct.unpack("<4sI", chunk)
            if name == b"data":
                if length < _UNKNOWN_SIZE and file.tell() + length > size:
                    there = (size - file.tell()) / max(length, 1)
                    raise UikaError(f"{source}: is cut short ({there:.0%} of its sound is there); save it again")
                return
            file.seek(length + length % 2, 1)
    raise UikaError(f"{source}: is a WAV file without sound")
