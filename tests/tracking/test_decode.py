"""Frames decoded ahead of their reader."""

import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from uika.io.video import write_video
from uika.tracking.decode import VideoError, decode, decode_ahead


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "ramp.mp4"
    write_video(path, (torch.full((48, 64, 3), index / 30) for index in range(30)), 25.0)
    return path


def test_frames_are_those_of_plain_decoding(video: Path) -> None:
    ahead, plain = list(decode_ahead(video, colour=True)), list(decode(video, colour=True))
    assert len(ahead) == len(plain) == 30
    for one, other in zip(ahead, plain, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_a_reader_that_stops_early_leaves_no_thread(video: Path) -> None:
    before = threading.active_count()
    frames = decode_ahead(video)
    next(frames)
    frames.close()
    assert threading.active_count() == before


def test_errors_reach_the_reader(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="no such video"):
        list(decode_ahead(tmp_path / "none.mp4"))
