"""The avatar as a camera of this machine, for programs that make calls or films."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uika.avatar import Avatar
from uika.avatar.framing import Framing, neutral_camera
from uika.errors import UikaError
from uika.head import HeadParameters
from uika.safeguards import mark
from uika.viewer.live import LiveSplats

SIZE = 512  # pixels
_FPS = 30
_AGAIN = 0.2  # seconds after which a picture is sent again: programs take a camera that says nothing for broken


class VirtualCamera:
    """Pictures of the avatar from the front, sent to a device that other programs read; close it with `stop`."""

    def __init__(self, avatar: Avatar, frame: Framing = "bust", size: int = SIZE, *, watermark: bool = True) -> None:
        """Open the first device that `pyvirtualcam` finds: v4l2loopback, or the one of OBS.

        Raises:
            UikaError: the package is not installed, or there is no such device; the message says what to do.
        """
        try:
            import pyvirtualcam
        except ModuleNotFoundError as error:
            raise UikaError("a virtual camera needs pyvirtualcam; run: pip install pyvirtualcam") from error
        try:
            self._device: Any = pyvirtualcam.Camera(size, size, _FPS)
        except (RuntimeError, OSError) as error:
            text = "; ".join(str(error).split("\n"))
            raise UikaError(
                f"no virtual camera can be opened ({text}); install v4l2loopback on Linux, OBS elsewhere"
            ) from error
        self._camera = neutral_camera(avatar, size=size, frame=frame)
        self._watermark = watermark
        self._picture: NDArray[np.uint8] | None = None
        self._sent = 0.0

    @property
    def name(self) -> str:
        """The device."""
        return str(self._device.device)

    def show(self, live: LiveSplats, params: HeadParameters) -> None:
        """Draw a pose and send it."""
        picture = live.draw(params, self._camera)
        self._picture = np.ascontiguousarray(mark(picture) if self._watermark else picture)
        self._send()

    def keep(self) -> None:
        """Send the last picture again when it is time."""
        if self._picture is not None and time.monotonic() - self._sent > _AGAIN:
            self._send()

    def stop(self) -> None:
        """Give the device back."""
        self._device.close()

    def _send(self) -> None:
        self._device.send(self._picture)
        self._sent = time.monotonic()
