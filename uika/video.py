"""Pictures on disk: MP4 and PNG files that appear under their names only when they are complete."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from uika.errors import UikaError
from uika.files import check_output, replacing

_QUALITY = "18"  # x264's constant rate factor; visually lossless for most eyes


def to_bytes(rgb: Tensor) -> NDArray[np.uint8]:
    """An image [H,W,3] in [0,1] as bytes; values outside are clipped."""
    return (rgb.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def write_png(path: str | Path, rgb: Tensor) -> None:
    """Write an image [H,W,3] in [0,1].

    Raises:
        UikaError: the name does not end in .png, or nothing can be written there.
    """
    from PIL import Image

    target = check_output(path, ".png")
    with replacing(target) as temporary:
        Image.fromarray(to_bytes(rgb)).save(temporary)


def write_video(path: str | Path, pictures: Iterable[Tensor], fps: float) -> int:
    """Write images [H,W,3] in [0,1] as H.264 in an MP4 that every player opens.

    Args:
        path: the file; it must end in .mp4.
        pictures: images of one size with an even number of rows and columns, taken one at a time.
        fps: frames per second.

    Returns:
        The number of frames.

    Raises:
        UikaError: bad name, no pictures, odd or changing picture sizes.
    """
    import av

    target = check_output(path, ".mp4")
    count, shape = 0, None
    with replacing(target) as temporary, av.open(str(temporary), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": _QUALITY}
        for picture in pictures:
            image = to_bytes(picture)
            if shape is None:
                shape = image.shape
                stream.height, stream.width = check_even(shape[0]), check_even(shape[1])
            if image.shape != shape:
                raise UikaError(f"{target}: frame {count} has the size {image.shape[:2]}, the first one {shape[:2]}")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            count += 1
        if count == 0:
            raise UikaError(f"{target}: there are no frames to write")
        container.mux(stream.encode())
    return count


def check_even(size: int) -> int:
    """The size, if H.264 with halved colour resolution can store it.

    Raises:
        UikaError: it is odd.
    """
    if size % 2:
        raise UikaError(f"video size must be an even number of pixels, not {size}")
    return size
