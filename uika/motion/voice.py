"""A voice where one is installed: espeak-ng, run as a program."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import unicodedata
from pathlib import Path

from uika.io.sound import Sound, read_sound
from uika.motion.motion import MotionError

PROGRAM = "espeak-ng"
MAX_TEXT = 5000  # characters; about six minutes
_WORDS_A_MINUTE = 150
_PATIENCE = 120  # seconds
# First word of a letter's Unicode name -> language that is usually written with it.
_SCRIPTS = {
    "CYRILLIC": "ru",
    "GREEK": "el",
    "ARABIC": "ar",
    "HEBREW": "he",
    "DEVANAGARI": "hi",
    "BENGALI": "bn",
    "TAMIL": "ta",
    "THAI": "th",
    "HANGUL": "ko",
    "HIRAGANA": "ja",
    "KATAKANA": "ja",
    "CJK": "cmn",
    "GEORGIAN": "ka",
    "ARMENIAN": "hy",
}


def check_text(text: str) -> str:
    """The text in one line of words.

    Raises:
        MotionError: it is empty, has no letters or digits, or is too long.
    """
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    if not any(c.isalnum() for c in words):
        raise MotionError("the text to speak has no words")
    if len(words) > MAX_TEXT:
        raise MotionError(f"the text to speak has {len(words)} characters; at most {MAX_TEXT} are spoken at once")
    return words


def has_voice() -> bool:
    """Whether espeak-ng is installed."""
    return shutil.which(PROGRAM) is not None


def language_of(text: str) -> str:
    """A guess from the script: English for Latin letters; Japanese if there are kana among Chinese characters."""
    scripts = [unicodedata.name(c, "").split(" ")[0].split("-")[0] for c in text if c.isalpha()]
    found = [_SCRIPTS[name] for name in scripts if name in _SCRIPTS]
    if 2 * len(found) <= len(scripts):
        return "en"
    return "ja" if "ja" in found else max(set(found), key=found.count)


def say(text: str, language: str | None = None) -> Sound:
    """The text as espeak-ng speaks it.

    Args:
        text: what to say.
        language: one of espeak-ng's voices, such as "en", "de" or "fr-fr"; None guesses from the letters.

    Raises:
        MotionError: espeak-ng is not installed, does not know the language, or the text has no words.
    """
    words = check_text(text)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "voice.wav"
        _run(words, language, "-s", str(_WORDS_A_MINUTE), "-w", str(target))
        if not target.is_file():
            raise MotionError(f"{PROGRAM} said nothing; try another language")
        return read_sound(target)


def pronounced(text: str, language: str | None = None) -> str:
    """The text in IPA: phonemes separated by _, words by spaces, clauses by line ends.

    Raises:
        MotionError: as `say`.
    """
    return _run(check_text(text), language, "-q", "--ipa", "--sep=_")


def _run(text: str, language: str | None, *options: str) -> str:
    program = shutil.which(PROGRAM)
    if program is None:
        raise MotionError(f"no voice: install {PROGRAM}, or give a recording")
    voice = language or language_of(text)
    # Through stdin, so that no text is taken for an option; -b 1 says that it is UTF-8.
    command = [program, "-v", voice, "-b", "1", "--stdin", *options]
    try:
        done = subprocess.run(command, input=text.encode(), capture_output=True, timeout=_PATIENCE)
    except subprocess.TimeoutExpired as error:
        raise MotionError(f"{PROGRAM} did not end within {_PATIENCE} seconds") from error
    if done.returncode:
        said = " ".join(done.stderr.decode(errors="replace").split())
        raise MotionError(f"{PROGRAM} cannot speak the language '{voice}' ({said}); `{PROGRAM} --voices` lists them")
    return done.stdout.decode("utf-8", errors="replace")
