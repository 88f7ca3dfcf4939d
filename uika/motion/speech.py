"""Speech: a text or a recording becomes a motion."""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numpy as np
import torch

from uika.head import HeadModel, load_head
from uika.io.sound import SUFFIXES, Sound, read_sound
from uika.motion.alignment import Phone, align, estimated
from uika.motion.liveliness import liveliness
from uika.motion.motion import Motion, MotionError
from uika.motion.mouth_shapes import Array, at_frames, from_phones, from_sound
from uika.motion.phonemes import KIND, phonemes
from uika.motion.read import for_head
from uika.motion.sound_features import features
from uika.motion.voice import has_voice, say

FPS = 25.0


def speech(
    spoken: str | Path | Sound,
    transcript: str | None = None,
    head: HeadModel | None = None,
    fps: float = FPS,
    *,
    language: str | None = None,
) -> Motion:
    """A face that speaks, with blinks, brows and small movements of the head; it starts and ends at rest.

    A text is spoken in the time that `uika.say` takes where espeak-ng is installed, else in an estimated time. A
    recording is followed by its sound alone, or better with its transcript.

    Args:
        spoken: a text, a sound file (.wav, .mp3, ...), or a sound.
        transcript: the words of the recording; a text is its own.
        head: the head that will speak; None loads the one that `load_head` finds.
        fps: frames per second.
        language: one of espeak-ng's voices, such as "en" or "de"; None guesses from the letters.

    Raises:
        MotionError: no words, no speech, or a transcript that does not fit.
        UikaError: the file cannot be read as sound.
    """
    if not 1 <= fps <= 240:
        raise MotionError(f"fps must lie between 1 and 240, not {fps:g}")
    sound = voice_of(spoken, language)
    words = transcript if sound is None or not is_text(spoken) else str(spoken)
    if sound is None:
        phones = estimated(phonemes(str(spoken), language))
        count = math.ceil(phones[-1].end * fps)
        loudness = _supposed_loudness(phones, fps, count)
        mouth = from_phones(phones, fps, count, loudness)
    else:
        heard, count = features(sound), math.ceil(sound.seconds * fps)
        loudness = at_frames(heard.envelope, fps, count)
        if words is None:
            mouth = from_sound(heard, fps, count)
        else:
            mouth = from_phones(align(phonemes(words, language), heard), fps, count, loudness)
    return for_head(_motion(mouth, loudness, fps), load_head() if head is None else head)


def voice_of(spoken: str | Path | Sound, language: str | None = None) -> Sound | None:
    """The sound that goes with `speech`: the recording, or the text's voice; None where no voice is installed."""
    if isinstance(spoken, Sound):
        return spoken
    if not is_text(spoken):
        return read_sound(spoken)
    return say(str(spoken), language) if has_voice() else None


def is_text(spoken: str | Path | Sound) -> bool:
    """Whether this is a text to speak, rather than a recording or its file."""
    if not isinstance(spoken, str):
        return False
    return not (" " not in spoken.strip() and spoken.lower().endswith(SUFFIXES)) and not _is_file(spoken)


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file() and Path(text).suffix.lower() in SUFFIXES
    except (OSError, ValueError):  # too long for a name, or with a zero in it
        return False


def _supposed_loudness(phones: list[Phone], fps: float, count: int) -> Array:
    """[count] in [0,1]: vowels are loud, pauses silent."""
    level = {"vowel": 0.9, "nasal": 0.6, "liquid": 0.7}
    values = [level.get(KIND.get(phone.symbol, ""), 0.4 if phone.symbol in KIND else 0.0) for phone in phones]
    middles = [(phone.start + phone.end) / 2 for phone in phones]
    return np.interp(np.arange(count) / fps, middles, values)


def _motion(mouth: Array, loudness: Array, fps: float) -> Motion:
    """A motion of the ARKit actions."""
    seed = zlib.crc32(np.round(loudness, 3).tobytes())
    alive = liveliness(loudness, fps, seed)
    still = torch.zeros(len(mouth), 3)
    return Motion(
        expression=torch.from_numpy((mouth + alive.actions).clip(0, 1)).float(),
        rotation=still,
        neck=torch.from_numpy(alive.neck).float(),
        jaw=still,
        eyes=torch.from_numpy(alive.eyes).float(),
        translation=still,
        fps=fps,
    )
