"""A camera of this machine whose face moves the avatar."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uika.errors import UikaError
from uika.head import HeadModel, HeadParameters
from uika.tracking import FaceFollower, VideoError

_PACE = 0.9  # share of the old value in the running mean of the rate


class CameraFace:
    """Follows the face before a camera in a thread of its own; close it with `stop`."""

    def __init__(self, number: int, head: HeadModel) -> None:
        """Open the camera and begin.

        Args:
            number: 0 for the first camera.
            head: the head model to move.

        Raises:
            VideoError: there is no such camera, or it may not be used.
        """
        self._name, self._camera = f"camera {number}", _opened(number)
        self._follower = FaceFollower(head)
        self._newest: HeadParameters | None = None
        self._lock, self._stopped = threading.Lock(), threading.Event()
        self._status = f"{self._name}: no face seen yet"
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def status(self) -> str:
        """What is going on, for the user."""
        return self._status

    def newest(self) -> HeadParameters | None:
        """The newest pose; None if it was handed out before."""
        with self._lock:
            found, self._newest = self._newest, None
        return found

    def stop(self) -> None:
        """Let go of the camera."""
        self._stopped.set()
        self._thread.join(10)

    def _work(self) -> None:
        from uika.photo.networks import follow_meshes

        try:
            rate, before = 0.0, time.perf_counter()
            for picture, landmarks in follow_meshes(self._pictures()):
                now = time.perf_counter()
                rate, before = _PACE * rate + (1 - _PACE) / max(now - before, 1e-3), now
                if landmarks is None:
                    self._status = f"{self._name}: no face"
                    continue
                pose = self._follower.see(landmarks, (picture.shape[1], picture.shape[0]), now)
                self._status = f"{self._name}: {f'{rate:.0f} pictures/s' if pose else 'learning the face'}"
                with self._lock:
                    self._newest = pose
        except (UikaError, ImportError) as error:
            self._status = str(error)
        finally:
            self._camera.release()

    def _pictures(self) -> Iterator[NDArray[np.uint8]]:
        while not self._stopped.is_set():
            good, picture = self._camera.read()
            if not good:
                raise VideoError(f"{self._name}: gives no more pictures")
            yield np.ascontiguousarray(picture[..., ::-1])


def _opened(number: int) -> Any:
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise UikaError('a camera needs OpenCV; run: pip install "uika-drjit[photo]"') from error

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below says it once
    camera = cv2.VideoCapture(number)
    if not camera.isOpened():
        raise VideoError(f"camera {number}: cannot be opened; is it plugged in, free, and allowed to be used?")
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest picture, not the oldest that waits
    return camera
