"""Speech: lips in step with the sound, closed where they must be, and refusals."""

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import uika
from tests.heads import sphere_head
from tests.spoken import spoken, write_wav
from uika import HeadModel, Motion, MotionError, load_head, say, speech
from uika.head import pose_vertices
from uika.head.actions import ARKIT_ACTIONS
from uika.io.sound import Sound
from uika.motion.alignment import Phone, align, estimated
from uika.motion.mouth_shapes import from_phones
from uika.motion.phonemes import GAP, KIND, PAUSE, phonemes
from uika.motion.sound_features import HOP, features
from uika.motion.speech import is_text
from uika.motion.voice import language_of

PARTS = [("_", 0.3), ("m", 0.12), ("a", 0.2), ("m", 0.1), ("i", 0.15), ("s", 0.15), ("u", 0.2), ("_", 0.4), ("a", 0.25),
         ("s", 0.12), ("a", 0.2), ("_", 0.3)]  # fmt: skip
SYMBOLS = ["m", "a", "m", "i", GAP, "s", "u", PAUSE, "a", "s", "a"]
TEXT = "Hello world, my mother bought five fresh fish. How much wood would a woodchuck chuck?"

needs_voice = pytest.mark.skipif(shutil.which("espeak-ng") is None, reason="no espeak-ng: install it to test voices")


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture
def no_voice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")


def opening(motion: Motion, head: HeadModel) -> np.ndarray:
    """Distance of the inner lips [T], metres, of a head held still."""
    params = motion.parameters(torch.zeros(len(head.identity_basis))).replace(neck=torch.zeros(len(motion), 3))
    marks, ids = head.landmarks(pose_vertices(head, params)), head.landmark_ids.tolist()
    return (marks[:, ids.index(13)] - marks[:, ids.index(14)]).norm(dim=-1).numpy()


def offset(motion: Motion, sound: Sound, head: HeadModel) -> float:
    """Milliseconds by which the mouth lies behind the sound's envelope, where their correlation is largest."""
    wide = opening(motion, head)
    loud = features(sound).envelope
    mouth = np.interp(np.arange(len(loud)) * HOP, np.arange(len(wide)) / motion.fps, wide)
    a, b = mouth - mouth.mean(), loud - loud.mean()
    lags = np.arange(-30, 31)
    found = [float(a[max(0, k) : len(a) + min(0, k)] @ b[max(0, -k) : len(b) - max(0, k)]) for k in lags]
    return float(1000 * HOP * lags[int(np.argmax(found))])


@pytest.mark.parametrize("fps", [25.0, 60.0])
def test_lips_are_in_step_with_a_recording(head: HeadModel, fps: float) -> None:
    sound = spoken(PARTS)
    motion = speech(sound, head=head, fps=fps)
    assert abs(len(motion) / fps - sound.seconds) <= 1 / fps
    assert abs(offset(motion, sound, head)) <= 60
    late = Sound(np.roll(sound.samples, round(0.1 * sound.rate)), sound.rate)
    assert 60 < abs(offset(motion, late, head)) <= 140  # the measure notices a delay of 100 ms


def test_a_transcript_is_found_in_the_recording() -> None:
    found = [phone for phone in align(SYMBOLS, features(spoken(PARTS)))]
    truth, time = [], 0.0
    for name, seconds in PARTS:
        truth.append(Phone(PAUSE if name == "_" else name, time, time + seconds))
        time += seconds
    assert [phone.symbol for phone in found] == [phone.symbol for phone in truth]
    assert max(abs(a.start - b.start) for a, b in zip(found, truth, strict=True)) <= 0.04
    assert all(a.end == b.start for a, b in itertools.pairwise(found))


def test_lips_shut_for_m_and_open_for_a() -> None:
    phones = estimated(list("amamama"))
    count = int(phones[-1].end * 60)
    actions = from_phones(phones, 60, count, np.ones(count))
    jaw, press = (actions[:, ARKIT_ACTIONS.index(name)] for name in ("jawOpen", "mouthPressLeft"))
    for phone in phones:
        frame = round((phone.start + phone.end) / 2 * 60)
        if phone.symbol == "m":
            assert press[frame] > 0.3 and jaw[frame] < 0.1
        elif phone.symbol == "a":
            assert jaw[frame] > 0.25 and press[frame] < 0.2


def test_vowels_without_a_transcript_have_their_lips(head: HeadModel) -> None:
    motion = speech(
        spoken([("_", 0.3), ("i", 0.4), ("_", 0.2), ("u", 0.4), ("_", 0.2), ("a", 0.4), ("_", 0.3)]), head=head
    )
    at = {"i": 12, "u": 27, "a": 42}
    level = {name: motion.expression[:, head.expression_names.index(name)] for name in ARKIT_ACTIONS}
    assert level["mouthStretchLeft"][at["i"]] > 2 * level["mouthStretchLeft"][at["u"]]
    assert level["mouthPucker"][at["u"]] > 2 * level["mouthPucker"][at["i"]]
    assert level["jawOpen"][at["a"]] > 1.5 * level["jawOpen"][at["u"]]
    assert level["jawOpen"][0] < 0.02


def test_a_speaker_blinks_moves_and_ends_at_rest(head: HeadModel) -> None:
    sound = spoken([*PARTS] * 4)
    motion = speech(sound, head=head)
    blink = motion.expression[:, head.expression_names.index("eyeBlinkLeft")]
    assert 2 <= int(((blink[1:] > 0.5) & (blink[:-1] <= 0.5)).sum()) <= 6
    assert float(motion.neck.abs().max()) > 0.02 and float(motion.eyes.abs().max()) > 0.02
    assert float(motion.neck[0].abs().max()) < 0.005 and float(motion.eyes[-1].abs().max()) < 0.01
    assert float((motion.neck[1:] - motion.neck[:-1]).abs().max()) < 0.03  # radians a frame: no jolts
    assert torch.equal(motion.expression, speech(sound, head=head).expression)


def test_text_without_a_voice_is_a_silent_motion(head: HeadModel, no_voice: None) -> None:
    motion = speech("Hello world, how are you?", head=head)
    assert 1.2 < len(motion) / motion.fps < 4
    assert float(motion.expression[:, head.expression_names.index("jawOpen")].max()) > 0.15
    assert uika.motion.speech.voice_of("Hello") is None
    with pytest.raises(MotionError, match="install espeak-ng"):
        say("Hello")
    with pytest.raises(MotionError, match="without espeak-ng only English"):
        speech("Привет, как дела?", head=head)
    with pytest.raises(MotionError, match="without espeak-ng only English"):
        speech("Guten Tag", head=head, language="de")


@pytest.mark.parametrize("text", ["", "   \n", "?!…", "\u200b"])
def test_a_text_without_words_is_refused(text: str, head: HeadModel) -> None:
    with pytest.raises(MotionError, match="has no words"):
        speech(text, head=head)


def test_a_transcript_that_does_not_fit_is_refused() -> None:
    heard = features(spoken(PARTS))
    with pytest.raises(MotionError, match="transcript does not fit the recording: 110 sounds in 1"):
        align(list("mamisumasa") * 11, heard)
    with pytest.raises(MotionError, match="does not fit"):
        align(["a"], features(spoken([*PARTS] * 6)))


def test_silence_and_snippets_are_refused(head: HeadModel) -> None:
    with pytest.raises(MotionError, match="silent"):
        speech(Sound(np.zeros(48_000, np.float32)), head=head)
    with pytest.raises(MotionError, match="too short"):
        speech(Sound(np.ones(400, np.float32)), head=head)
    with pytest.raises(MotionError, match="5000 are spoken"):
        speech("word " * 1001, head=head)
    with pytest.raises(MotionError, match="fps"):
        speech("Hello", head=head, fps=0)


def test_texts_and_files_are_told_apart(tmp_path: Path) -> None:
    assert is_text("Hello there") and is_text("Listen to song.wav") and is_text("x" * 10_000) and is_text("a\0b")
    assert not is_text("missing.wav") and not is_text(tmp_path / "a.wav")
    spaced = write_wav(tmp_path / "my voice.wav", spoken(PARTS).samples)
    assert not is_text(str(spaced))


def test_another_head_without_lips_is_refused(head: HeadModel) -> None:
    with pytest.raises(MotionError, match="landmarks"):
        speech(spoken(PARTS), head=sphere_head())


def test_scripts_have_languages() -> None:
    texts = {
        "en": "Hello",
        "ru": "Привет, как дела?",
        "ja": "日本語を話します",
        "cmn": "你好",
        "el": "Καλημέρα",
        "ar": "مرحبا",
    }
    assert {language: language_of(text) for language, text in texts.items()} == {name: name for name in texts}


@needs_voice
@pytest.mark.parametrize("text", [TEXT, "Привет, как у тебя дела сегодня?", "Le soleil brille sur la mer aujourd'hui."])
def test_a_voice_and_its_lips_are_in_step(text: str, head: HeadModel) -> None:
    sound = say(text)
    assert abs(offset(speech(sound, text, head), sound, head)) <= 60
    assert abs(offset(speech(sound, head=head), sound, head)) <= 60
    assert torch.equal(speech(text, head=head).expression, speech(sound, text, head).expression)


@needs_voice
def test_phonemes_of_a_voice() -> None:
    found = phonemes("Judge my boat, she said.")
    assert "".join(found) == "dʒʌdʒ maɪ bəʊt_ʃi sɛd"
    assert set(phonemes(TEXT)) <= {*KIND, GAP, PAUSE}
    with pytest.raises(MotionError, match="cannot speak the language 'xx-none'"):
        phonemes("Hello", "xx-none")
    assert phonemes("-v de") == phonemes("- v de")  # no text is taken for an option
