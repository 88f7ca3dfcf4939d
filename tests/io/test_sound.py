"""Sound files of every kind, damaged ones, and sound beside a film's pictures."""

import struct
from pathlib import Path

import av
import numpy as np
import pytest

from tests.spoken import spoken, write_wav
from uika import UikaError
from uika.io.sound import RATE, Sound, read_sound
from uika.io.video import write_video

PARTS = [("_", 0.2), ("a", 0.3), ("_", 0.2), ("s", 0.2), ("_", 0.1)]


def onset(samples: np.ndarray, rate: int = RATE) -> float:
    """Seconds until the sound begins."""
    return float(np.flatnonzero(np.abs(samples) > 0.05)[0] / rate)


@pytest.mark.parametrize(
    ("rate", "channels", "bits"), [(48_000, 1, 16), (96_000, 2, 16), (8_000, 1, 8), (44_100, 6, 16)]
)
def test_wav_files_of_all_kinds_hold_the_same_sound(tmp_path: Path, rate: int, channels: int, bits: int) -> None:
    sound = spoken(PARTS, rate)
    read = read_sound(write_wav(tmp_path / "a.wav", sound.samples, rate, channels, bits))
    assert read.rate == RATE and abs(read.seconds - sound.seconds) < 0.01
    assert abs(onset(read.samples) - onset(sound.samples, rate)) < 0.01
    assert 0.05 < np.abs(read.samples).max() <= 1


def test_mp3_is_read(tmp_path: Path) -> None:
    sound = spoken(PARTS)
    with av.open(str(tmp_path / "a.mp3"), "w") as container:
        stream = container.add_stream("mp3", rate=RATE, layout="mono")
        stream.format = "fltp"
        for start in range(0, len(sound.samples), 1152):
            block = np.ascontiguousarray(sound.samples[None, start : start + 1152])
            frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
            frame.sample_rate, frame.pts = RATE, start
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    read = read_sound(tmp_path / "a.mp3")
    assert abs(onset(read.samples) - 0.2) < 0.03 and abs(read.seconds - sound.seconds) < 0.1


def test_what_is_no_whole_sound_is_refused_by_name(tmp_path: Path) -> None:
    whole = write_wav(tmp_path / "whole.wav", spoken(PARTS).samples)
    cut = tmp_path / "cut.wav"
    cut.write_bytes(whole.read_bytes()[:40_000])
    with pytest.raises(UikaError, match=r"cut\.wav: is cut short \(42%"):
        read_sound(cut)
    with pytest.raises(UikaError, match=r"none\.wav: no such sound file"):
        read_sound(tmp_path / "none.wav")
    (tmp_path / "text.wav").write_text("hello")
    with pytest.raises(UikaError, match=r"text\.wav: cannot be read as sound"):
        read_sound(tmp_path / "text.wav")
    with pytest.raises(UikaError, match=r"empty\.wav: holds no sound"):
        read_sound(write_wav(tmp_path / "empty.wav", np.zeros(0)))
    write_video(tmp_path / "silent.mp4", [np.zeros((16, 16, 3), np.uint8)], 25)
    with pytest.raises(UikaError, match=r"silent\.mp4: holds no sound"):
        read_sound(tmp_path / "silent.mp4")


def test_three_hours_are_refused_before_they_are_read(tmp_path: Path) -> None:
    count = 3 * 3600 * 8000
    kind = struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 1, 8000, 8000, 1, 8)
    long = tmp_path / "long.wav"
    with long.open("wb") as file:
        file.write(struct.pack("<4sI4s", b"RIFF", 36 + count, b"WAVE") + kind + struct.pack("<4sI", b"data", count))
        file.truncate(44 + count)  # a sparse file
    with pytest.raises(UikaError, match="longer than 10 minutes"):
        read_sound(long)


def test_a_wav_that_went_through_a_pipe_has_no_size_and_is_read(tmp_path: Path) -> None:
    path = write_wav(tmp_path / "a.wav", spoken(PARTS).samples)
    data = bytearray(path.read_bytes())
    data[40:44] = struct.pack("<I", 0xFFFFFFFF)
    path.write_bytes(data)
    assert abs(read_sound(path).seconds - 1.0) < 0.01


@pytest.mark.parametrize("fps", [25.0, 29.97])
def test_sound_lies_in_the_film_where_it_lay(tmp_path: Path, fps: float) -> None:
    sound = spoken([("_", 0.5), ("a", 0.3), ("_", 1.2)])
    write_video(tmp_path / "a.mp4", [np.zeros((16, 16, 3), np.uint8)] * 50, fps, sound=sound)
    read = read_sound(tmp_path / "a.mp4")
    assert abs(onset(read.samples) - 0.5) < 0.01
    assert abs(read.seconds - 50 / fps) < 0.05
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert [stream.codec_context.name for stream in container.streams] == ["h264", "aac"]
        assert sum(1 for _ in container.decode(video=0)) == 50


def test_sound_longer_than_the_pictures_is_left_out(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [np.zeros((16, 16, 3), np.uint8)] * 5, 25, sound=spoken([("a", 3)]))
    assert read_sound(tmp_path / "a.mp4").seconds < 0.3
    assert Sound(np.zeros(480, np.float32)).seconds == 0.01
