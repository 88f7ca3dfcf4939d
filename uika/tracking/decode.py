"""Frames of a video file."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uika.errors import UikaError
from uika.io.media import open_media
from uika.io.upright import shown_width, upright

_STILL_CODECS = ("mjpeg", "png", "bmp", "webp", "gif")
AHEAD = 8  # frames
DEFAULT_FPS = 25.0  # where the file does not say
MAX_PIXELS = 36_000_000  # of a frame; 8K has fewer


class VideoError(UikaError):
    """A video that cannot be read or shows no face; the message names it."""


class VideoFrame(NamedTuple):
    """One frame, turned as it is meant to be seen."""

    grey: NDArray[np.uint8]  # [H,W]
    rgb: NDArray[np.uint8]  # [H,W,3] sRGB; empty if colour was not asked for
    seconds: float | None  # when it is shown, if the file says


def video_frames(path: str | Path) -> Iterator[NDArray[np.uint8]]:
    """The frames [H,W,3] of a video, sRGB, turned as a player shows them.

    Raises:
        VideoError: the file is missing or no video.
    """
    for frame in decode(Path(path), colour=True):
        yield frame.rgb


def decode(path: Path, colour: bool = False) -> Iterator[VideoFrame]:
    """Each frame in grey and, if asked for, in colour.

    Raises:
        VideoError: the file is missing or no video.
    """
    import av

    if not path.is_file():
        raise VideoError(f"{path}: no such video")
    try:
        with open_media(path) as container:
            stream = _moving(path, container)
            stream.thread_type = "AUTO"
            aspect, size = stream.sample_aspect_ratio, None
            for frame in container.decode(stream):
                width = shown_width(frame, aspect)
                if width * frame.height > MAX_PIXELS:
                    raise VideoError(f"{path}: has {width}x{frame.height} pixels a frame; {MAX_PIXELS:,} are the most")
                if size is not None and (frame.width, frame.height) != size:
                    raise VideoError(
                        f"{path}: changes from {size[0]}x{size[1]} to {frame.width}x{frame.height} pixels at "
                        f"{frame.time or 0:.2f} s; convert it to one size"
                    )
                size = (frame.width, frame.height)
                grey: Any = upright(frame.to_ndarray(format="gray", width=width), frame)
                rgb: Any = upright(frame.to_ndarray(format="rgb24", width=width), frame) if colour else grey[:0]
                yield VideoFrame(grey, rgb, frame.time)
    except VideoError:
        raise
    except (av.FFmpegError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise VideoError(f"{path}: cannot be read as a video ({reason})") from error


def _moving(path: Path, container: Any) -> Any:
    """The stream of moving pictures; covers of songs and films are still ones that FFmpeg lists among them."""
    if container.streams.video and all(stream.codec_context is None for stream in container.streams.video):
        raise VideoError(f"{path}: has pictures of a kind that FFmpeg does not know here; convert it to H.264")
    moving = [each for each in container.streams.video if each.codec_context is not None and not _is_cover(each)]
    if not moving:
        covers = " besides its cover" if container.streams.video else ""
        raise VideoError(f"{path}: has no moving pictures in it{covers}")
    films = [stream for stream in moving if stream.codec_context.name not in _STILL_CODECS]
    return (films or moving)[0]  # Matroska files do not always say that a picture is a cover


def _is_cover(stream: Any) -> bool:
    disposition = getattr(stream, "disposition", None)
    return disposition is not None and "attached_pic" in str(getattr(disposition, "name", disposition))


def decode_ahead(path: Path, colour: bool = False) -> Iterator[VideoFrame]:
    """`decode` in a thread of its own, a few frames ahead of whoever reads them."""
    frames: queue.Queue[VideoFrame | BaseException | None] = queue.Queue(AHEAD)
    stopped = threading.Event()

    def put(item: VideoFrame | BaseException | None) -> None:
        while not stopped.is_set():
            try:
                return frames.put(item, timeout=0.1)
            except queue.Full:
                continue

    def work() -> None:
        try:
            for frame in decode(path, colour):
                put(frame)
                if stopped.is_set():
                    return
            put(None)
        except BaseException as error:  # raised again where the frames are read
            put(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while (item := frames.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stopped.set()
        thread.join()


def frame_rate(path: Path) -> float:
    """Frames per second.

    Raises:
        VideoError: the file is no video.
    """
    import av

    try:
        with open_media(path) as container:
            rate = _moving(path, container).average_rate
    except VideoError:
        raise
    except (av.FFmpegError, OSError, LookupError, ValueError) as error:
        raise VideoError(f"{path}: cannot be read as a video ({error})") from error
    return float(rate) if rate else DEFAULT_FPS
