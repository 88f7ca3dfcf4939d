"""`uika animate --speech`."""

from pathlib import Path

import av
import pytest

from tests.avatars import painted_avatar
from tests.spoken import spoken, write_wav
from uika import load_head, read_sound
from uika.cli import main

PARTS = [("_", 0.2), ("a", 0.2), ("m", 0.1), ("a", 0.2), ("_", 0.1)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    painted_avatar(load_head(), 32).save(tmp_path / "me.safetensors")
    write_wav(tmp_path / "voice.wav", spoken(PARTS).samples)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_recording_is_seen_and_heard(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "words.txt").write_text("Mama")
    words = ("--transcript", "words.txt", "--size", "64", "-o", "a.mp4")
    assert main(["animate", "me.safetensors", "--speech", "voice.wav", *words]) == 0
    assert "20 frames" in (said := capsys.readouterr().out) and said.strip().endswith("with sound")
    assert abs(read_sound("a.mp4").seconds - 0.8) < 0.05
    with av.open("a.mp4") as container:
        assert sum(1 for _ in container.decode(video=0)) == 20


def test_without_a_voice_the_film_is_silent_and_says_so(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    assert main(["animate", "me.safetensors", "--speech", "Hello", "--size", "64", "-o", "a.mp4"]) == 0
    assert "silent: install espeak-ng" in capsys.readouterr().out
    with av.open("a.mp4") as container:
        assert not container.streams.audio


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--speech", ""), "has no words"),
        (("--speech", "none.wav"), "none.wav: no such sound file"),
        (("--speech", "voice.wav", "--transcript", "none.txt"), "none.txt: no such text file"),
        (("--speech", "voice.wav", "--transcript", "voice.wav"), "voice.wav: is no text in UTF-8"),
        (("--speech", "voice.wav", "--transcript", "long.txt"), "transcript does not fit"),
        (("--speech", "Hello", "--transcript", "long.txt"), "goes with a recording"),
        (("--transcript", "long.txt"), "go with --speech"),
        (("--speech", "Hello", "--video", "a.mp4"), "give one of them"),
    ],
)
def test_refusals(folder: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str) -> None:
    (folder / "long.txt").write_text("many words that nobody speaks in a second " * 20)
    assert main(["animate", "me.safetensors", *options, "-o", "out.mp4"]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(folder.glob("*out*"))
