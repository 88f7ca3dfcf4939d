"""Pictures drawn here and shown behind the scene, for browsers without a graphics card."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from uika.head import HeadParameters
from uika.safeguards import mark
from uika.viewer.live import LiveSplats
from uika.viewer.still import camera_of

HERE, BROWSER = "drjit_splat", "the browser"
_HEIGHT = 480  # pixels
_QUALITY = 85  # of JPEG


class Painting:
    """Who draws the Gaussians, and the drawing where it is done here."""

    def __init__(self, gui: Any, server: Any, splats: Any, watermark: bool, moved: Callable[[], None]) -> None:
        """Add the choice; `moved` is called when a picture is due."""
        self._server, self._splats, self._watermark, self._moved = server, splats, watermark, moved
        self._choice = gui.add_dropdown("drawn by", (BROWSER, HERE))
        self._choice.on_update(lambda _: self._switch())
        server.on_client_connect(self._watch)

    @property
    def here(self) -> bool:
        """Whether pictures are drawn here."""
        return bool(self._choice.value == HERE)

    def show(self, live: LiveSplats, params: HeadParameters) -> None:
        """Draw a pose for every browser, each from its own camera."""
        for client in self._server.get_clients().values():
            camera = client.camera
            view = (camera.wxyz, camera.position, camera.fov)
            picture = live.draw(params, camera_of(view, max(1, round(_HEIGHT * camera.aspect)), _HEIGHT))
            marked = mark(picture) if self._watermark else picture
            client.scene.set_background_image(marked, format="jpeg", jpeg_quality=_QUALITY)

    def _watch(self, client: Any) -> None:
        client.camera.on_update(lambda _: self._moved() if self.here else None)

    def _switch(self) -> None:
        self._splats.visible = not self.here
        if self.here:
            self._splats.buffer = np.zeros((1, 8), np.uint32)  # hidden ones would still be looked at for every picture
        else:
            for client in self._server.get_clients().values():
                client.scene.set_background_image(None)
        self._moved()
