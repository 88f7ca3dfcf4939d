"""The command that opens the viewer."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from uika.errors import UikaError


@dataclass(frozen=True)
class View:
    """Show an avatar on a page of this machine and move it with sliders.

    Example: uika view me.safetensors --motion talk
    """

    avatar: Positional[Path]
    """The avatar file."""
    motion: str = "talk"
    """orbit, talk, expressions or a motion file, to play."""
    video: Path | None = None
    """A video to be driven by, or the number of a camera (0 is the first) to follow live."""
    live_link: int | None = None
    """The UDP port on which Live Link Face's packets are taken and followed; the app sends to 11111."""
    listen: str = "127.0.0.1"
    """The address of this machine on which they are taken; 0.0.0.0 lets a phone in the same network reach it."""
    count: int | None = None
    """Show at most so many Gaussians."""
    port: int = 8080
    """The port on 127.0.0.1; a higher one if it is taken."""
    frame: Literal["bust", "head"] = "bust"
    """What is framed: the portrait with its shoulders, or the head alone."""
    watermark: bool = True
    """Mark the pictures that the page renders."""
    virtual_camera: bool = False
    """Also show the avatar as a camera that other programs can choose; needs the package pyvirtualcam."""

    def run(self) -> int:
        """Serve until interrupted."""
        if not 1024 <= self.port <= 65535:
            raise UikaError(f"port must lie between 1024 and 65535, not {self.port}")
        if self.live_link is not None and (self.video is not None or not 1 <= self.live_link <= 65535):
            raise UikaError("--live-link takes a port between 1 and 65535, and no --video beside it")
        if self.listen != "127.0.0.1" and self.live_link is None:
            raise UikaError("--listen goes with --live-link; the page itself stays on 127.0.0.1")
        from uika.avatar import Avatar
        from uika.avatar.rendering import check_renderer
        from uika.export import thinned
        from uika.head import load_head
        from uika.motion.presets import get_motion
        from uika.viewer import CameraFace, LiveLinkFace, Viewer, VirtualCamera

        avatar, head = Avatar.load(self.avatar), load_head()
        avatar.check_head(head)
        if self.count is not None:
            avatar = thinned(avatar, self.count)
        check_renderer()
        number = self._camera_number()
        if self.video is None or number is not None:
            motion = get_motion(self.motion, head)
        else:
            from uika.tracking import track_video

            motion = track_video(self.video, head, progress=True).motion
        camera: CameraFace | LiveLinkFace | None = None if number is None else CameraFace(number, head)
        if self.live_link is not None:
            camera = LiveLinkFace(head, self.live_link, self.listen)
            print(f"listening for Live Link Face on {':'.join(map(str, camera.place))} (UDP)", flush=True)
        shown = VirtualCamera(avatar, self.frame, watermark=self.watermark) if self.virtual_camera else None
        if shown is not None:
            print(f"the avatar is the camera {shown.name}", flush=True)
        options: dict[str, Any] = {"camera": camera, "frame": self.frame, "virtual_camera": shown}
        with Viewer(avatar, head, motion, self.port, watermark=self.watermark, **options) as viewer:
            print(f"open {viewer.url} in a browser; Ctrl-C ends", flush=True)
            while True:
                time.sleep(1.0)

    def _camera_number(self) -> int | None:
        """The camera that `video` names; None if it names a file."""
        name = "" if self.video is None else str(self.video)
        return int(name) if name.isdecimal() and not Path(name).exists() else None
