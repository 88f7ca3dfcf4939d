"""Videos as phones and conferences record them: turned, mirrored, stretched and at no steady pace."""

import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from tests.filmed import act_pictures
from uika.head import HeadModel, load_head, rodrigues
from uika.tracking import VideoError, track_video, video_frames, write_preview
from uika.tracking.decode import decode, decode_ahead, frame_rate

ONE = 1 << 16
# What is done to a picture before it is stored -> the display matrix (a, b, c, d) that undoes it.
STORED = {
    "as it is": (lambda p: p, (1, 0, 0, 1)),
    "turned left": (lambda p: np.rot90(p, 1), (0, 1, -1, 0)),
    "turned right": (lambda p: np.rot90(p, -1), (0, -1, 1, 0)),
    "upside down": (lambda p: np.rot90(p, 2), (-1, 0, 0, -1)),
    "mirrored": (lambda p: p[:, ::-1], (-1, 0, 0, 1)),
    "flipped": (lambda p: p[::-1], (1, 0, 0, -1)),
    "transposed": (lambda p: p.swapaxes(0, 1), (0, 1, 1, 0)),
    "mirrored and turned": (lambda p: np.rot90(p[:, ::-1], -1), (0, -1, -1, 0)),
}


def picture() -> np.ndarray:
    """Four corners of different colours."""
    image = np.full((48, 64, 3), 128, np.uint8)
    image[:24, :32], image[:24, 32:], image[24:, :32] = (230, 20, 20), (20, 230, 20), (20, 20, 230)
    return image


def record(path: Path, pictures: Iterable[np.ndarray], times: Iterable[float], aspect: Fraction | None = None) -> Path:
    """An H.264 file of pictures shown at these seconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12", "bf": "0"})
        stream.time_base = stream.codec_context.time_base = Fraction(1, 90000)
        for index, (image, time) in enumerate(zip(pictures, times, strict=True)):
            if index == 0:
                stream.height, stream.width, stream.pix_fmt = *image.shape[:2], "yuv420p"
                if aspect:
                    stream.sample_aspect_ratio = aspect
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(time * 90000), Fraction(1, 90000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def note_matrix(path: Path, matrix: tuple[int, ...]) -> None:
    """Write a display matrix into the header of an MP4's first track."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd")
    place = start + (56 if data[start + 4] else 44)
    a, b, c, d = (ONE * value for value in matrix)
    data[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@pytest.mark.parametrize("way", STORED)
def test_frames_are_turned_as_the_display_matrix_says(way: str, tmp_path: Path) -> None:
    change, matrix = STORED[way]
    path = record(tmp_path / "phone.mp4", [change(picture())] * 2, (0, 0.04))
    note_matrix(path, matrix)
    for frame in decode_ahead(path, colour=True):
        assert frame.rgb.shape == (48, 64, 3) and frame.grey.shape == (48, 64)
        assert np.abs(frame.rgb.astype(int) - picture()).mean() < 8
        assert np.abs(frame.grey[:20, :28].astype(int) - int(frame.grey[2, 2])).mean() < 4


@pytest.mark.parametrize("aspect", [Fraction(4, 3), Fraction(2), Fraction(1, 2)])
def test_pixels_that_are_not_square_are_stretched(aspect: Fraction, tmp_path: Path) -> None:
    path = record(tmp_path / "tv.mp4", [picture()] * 2, (0, 0.04), aspect)
    assert {frame.shape for frame in video_frames(path)} == {(48, round(64 * aspect), 3)}


@pytest.mark.parametrize("sizes", [((48, 64), (64, 48)), ((48, 64), (96, 128)), ((96, 128), (48, 64))])
def test_a_size_that_changes_is_named(sizes: tuple[tuple[int, int], ...], tmp_path: Path) -> None:
    path = tmp_path / "call.ts"
    parts = [record(tmp_path / f"{k}.ts", [np.zeros((*size, 3), np.uint8)] * 3, (0, 0.04, 0.08))
             for k, size in enumerate(sizes)]  # fmt: skip
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(VideoError, match=r"call\.ts: changes from .* to .* pixels"):
        list(decode(path))


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


UNEVEN = {
    "every third lost": [k for k in range(36) if k % 3 != 1],
    "a pause": [k for k in range(36) if not 11 < k < 21],
    "half the rate at the end": [*range(18), *range(18, 36, 2)],
}


@pytest.mark.slow
@pytest.mark.parametrize("kept", UNEVEN)
def test_a_motion_lasts_as_long_as_its_video(kept: str, head: HeadModel, tmp_path: Path) -> None:
    pictures, yaw = act_pictures(head, 36)
    frames = UNEVEN[kept]
    video = record(tmp_path / "u.mp4", [pictures[k] for k in frames], [k / 25 for k in frames])
    found = track_video(video, head)
    assert found.motion.fps == pytest.approx(25, rel=0.01) and len(found.poses) == len(found.motion)
    assert len(found.motion) == pytest.approx(frames[-1] + 1, abs=1)
    # A head with a bust turns by its neck, one without by its root.
    turned = rodrigues(found.motion.rotation) @ rodrigues(found.motion.neck)
    angle = torch.atan2(turned[:, 0, 2], turned[:, 2, 2])
    shared = min(len(angle), len(yaw))
    at = torch.tensor([k for k in frames if k < shared])
    assert float(torch.rad2deg((angle[at] - yaw[at]).abs()).median()) < 6.0
    assert write_preview(found, video, tmp_path / "p.mp4", head) == len(found.motion)


def with_cover(path: Path, film: bool) -> Path:
    """A film or a song whose first stream of pictures is a red cover."""
    with av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.height, cover.width, cover.pix_fmt = 96, 96, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic
        other = container.add_stream("libx264" if film else "aac", rate=25 if film else 48000)
        if film:
            other.height, other.width, other.pix_fmt = 48, 64, "yuv420p"
        for packet in cover.encode(av.VideoFrame.from_ndarray(np.full((96, 96, 3), (250, 0, 0), np.uint8))):
            container.mux(packet)
        container.mux(cover.encode(None))
        for _ in range(3):
            if film:
                container.mux(other.encode(av.VideoFrame.from_ndarray(picture(), format="rgb24")))
            else:
                sound = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
                sound.rate = 48000
                container.mux(other.encode(sound))
        container.mux(other.encode(None))
    return path


@pytest.mark.parametrize("name", ["film.mp4", "film.mkv", "film.mov"])
def test_a_films_cover_is_not_its_first_frame(name: str, tmp_path: Path) -> None:
    path = with_cover(tmp_path / name, film=True)
    assert [frame.shape for frame in video_frames(path)] == [(48, 64, 3)] * 3
    assert frame_rate(path) == pytest.approx(25, rel=0.3)


@pytest.mark.parametrize("name", ["song.mp4", "song.mov"])
def test_a_songs_cover_is_no_video(name: str, tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="has no moving pictures in it"):
        list(decode(with_cover(tmp_path / name, film=False)))
