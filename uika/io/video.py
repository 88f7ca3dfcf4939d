"""Pictures on disk: MP4 and PNG files that appear under their names only when they are complete."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from uika.errors import UikaError
from uika.io.files import check_output, replacing
from uika.io.sound import Sound, SoundTrack

_QUALITY = "18"  # x264's constant rate factor; visually lossless for most eyes
_AHEAD = 4  # pictures that may wait for the encoder


Picture = Tensor | NDArray[np.uint8]  # [H,W,3], floats in [0,1] or bytes


def to_bytes(rgb: Picture) -> NDArray[np.uint8]:
    """An image [H,W,3] in [0,1] as bytes; values outside are clipped. Bytes are passed on."""
    if isinstance(rgb, np.ndarray):
        return rgb
    return (rgb.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def write_png(path: str | Path, rgb: Tensor, provenance: Mapping[str, str] | None = None) -> None:
    """Write an image [H,W,3] in [0,1], with `provenance` as JSON in a text chunk of that name.

    Raises:
        UikaError: the name does not end in .png, or nothing can be written there.
    """
    from PIL import Image, PngImagePlugin

    target = check_output(path, ".png")
    text = PngImagePlugin.PngInfo()
    if provenance:
        text.add_itxt("provenance", json.dumps(dict(provenance)))
    with replacing(target) as temporary:
        Image.fromarray(to_bytes(rgb)).save(temporary, pnginfo=text)


def write_video(
    path: str | Path,
    pictures: Iterable[Picture],
    fps: float,
    provenance: Mapping[str, str] | None = None,
    sound: Sound | None = None,
) -> int:
    """Write images [H,W,3] in [0,1], or as bytes, as H.264 in an MP4 that every player opens.

    The encoder works in a thread of its own while the next pictures are made.

    Args:
        path: the file; it must end in .mp4.
        pictures: images of one size with an even number of rows and columns, taken one at a time.
        fps: frames per second.
        provenance: kept as JSON in the file's comment.
        sound: heard from the first picture on (AAC); what lasts longer than the pictures is left out.

    Returns:
        The number of frames.

    Raises:
        UikaError: bad name, no pictures, odd or changing picture sizes.
    """
    import av

    target = check_output(path, ".mp4")
    count, shape = 0, None
    with (
        replacing(target) as temporary,
        av.open(str(temporary), "w", options={"movflags": "faststart"}) as container,
        ThreadPoolExecutor(1) as encoder,
    ):
        pending: deque[Future[None]] = deque()
        if provenance:
            container.metadata["comment"] = json.dumps(dict(provenance))
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": _QUALITY}
        track = None if sound is None else SoundTrack(container, sound)

        def encode(image: NDArray[np.uint8], end: float) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            if track is not None:
                track.until(end)

        for picture in pictures:
            image = to_bytes(picture)
            if shape is None:
                shape = image.shape
                stream.height, stream.width = check_even(shape[0]), check_even(shape[1])
            if image.shape != shape:
                raise UikaError(f"{target}: frame {count} has the size {image.shape[:2]}, the first one {shape[:2]}")
            count += 1
            pending.append(encoder.submit(encode, image, count / fps))
            if len(pending) > _AHEAD:
                pending.popleft().result()
        if count == 0:
            raise UikaError(f"{target}: there are no frames to write")
        while pending:
            pending.popleft().result()
        container.mux(stream.encode())
        if track is not None:
            track.finish()
    return count


def check_even(size: int) -> int:
    """The size, if H.264 with halved colour resolution can store it.

    Raises:
        UikaError: it is odd.
    """
    if size % 2:
        raise UikaError(f"video size must be an even number of pixels, not {size}")
    return size
