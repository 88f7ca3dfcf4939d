"""Text as phonemes, in IPA: by espeak-ng where it is installed, else by openfacefx's rules for English."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator

from uika.motion.motion import MotionError
from uika.motion.voice import check_text, has_voice, language_of, pronounced

PAUSE, GAP = "_", " "  # between clauses, and between words, where a speaker may pause
# What a phoneme sounds like to a microphone, for alignment.
_KINDS = {
    "vowel": "aɑæʌɐəäɶɛeɪøœɘiɨᵻɔoɒɤɵuʊyʉɯɜɝɚ",
    "nasal": "mnŋɲɱɳ",
    "liquid": "lɫɾɭʎrɹɻʀʁɽjwʍɥʋ",
    "stop": "ptkʈcqʔ",
    "voiced_stop": "bdɡgɖɟɢ",
    "sibilant": "sʃʂɕ",
    "voiced_sibilant": "zʒʐʑ",
    "weak_fricative": "fθhxçχɦ",
    "voiced_fricative": "vðɣβʝɰ",
}
KIND = {symbol: kind for kind, symbols in _KINDS.items() for symbol in symbols}
_AFFRICATES = {"tʃ": "ʃ", "dʒ": "ʒ", "ts": "s", "dz": "z", "tɕ": "ɕ", "dʑ": "ʑ"}
_LATIN = re.compile(r"[A-Za-z']+")
_LANGUAGE_MARK = re.compile(r"\([a-z-]+\)")


def phonemes(text: str, language: str | None = None) -> list[str]:
    """The sounds of a text in order: single IPA symbols of `KIND`, `GAP` between words, `PAUSE` between clauses.

    Args:
        text: what is said.
        language: a voice of espeak-ng; None guesses from the letters.

    Raises:
        MotionError: the text has no words, or only words that cannot be pronounced without espeak-ng.
    """
    words = check_text(text)
    found = _from_ipa(pronounced(words, language)) if has_voice() else _from_rules(words, language)
    if not any(symbol in KIND for symbol in found):
        raise MotionError("the text to speak has no words that can be pronounced; name its language")
    return found


def seconds_of(symbol: str) -> float:
    """How long a sound takes on average; Klatt (1976) gives vowels about twice a consonant's time."""
    if symbol == PAUSE:
        return 0.28
    return {GAP: 0.0, "vowel": 0.11, "sibilant": 0.1}.get(KIND.get(symbol, symbol), 0.065)


def _from_ipa(ipa: str) -> list[str]:
    clauses = [line for line in _LANGUAGE_MARK.sub("", ipa).splitlines() if line.strip()]
    result: list[str] = []
    for clause in clauses:
        result += [PAUSE] if result else []
        for number, word in enumerate(clause.split()):
            result += [GAP] if number else []
            for token in word.split("_"):
                result += _symbols(token)
    return result


def _symbols(token: str) -> Iterator[str]:
    """A token's parts: both halves of a diphthong; an affricate is a short closure and its fricative."""
    bare = "".join(c for c in unicodedata.normalize("NFD", token) if not unicodedata.combining(c))
    bare = unicodedata.normalize("NFC", bare)
    if bare in _AFFRICATES:
        bare = bare[0] + _AFFRICATES[bare]
    yield from (symbol for symbol in bare if symbol in KIND)


def _from_rules(words: str, language: str | None) -> list[str]:
    from openfacefx import G2P, to_ipa

    if language not in (None, "en") or language_of(words) != "en" or not _LATIN.search(words):
        raise MotionError("without espeak-ng only English can be pronounced; install it, or give a recording alone")
    rules, result = G2P(), list[str]()
    for clause in re.split(r"[.,;:!?]+", words):
        heard = ([s for p in rules.word(word) for s in _symbols(to_ipa(p))] for word in _LATIN.findall(clause))
        spoken = [word for word in heard if word]
        result += [PAUSE] if result and spoken else []
        for number, word in enumerate(spoken):
            result += [GAP, *word] if number else word
    return result
