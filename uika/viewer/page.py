"""The page: what it shows, and the thread that poses what its controls ask for."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from uika.avatar import Avatar
from uika.avatar.framing import Framing, neutral_camera, target_and_distance
from uika.errors import UikaError
from uika.head import HeadModel, HeadParameters
from uika.io.video import to_bytes
from uika.motion import Motion
from uika.safeguards import mark
from uika.viewer.controls import LiveFace
from uika.viewer.live import UNITS, LiveSplats
from uika.viewer.painting import Painting
from uika.viewer.panels import IdentityPanel, MotionPanel, PosePanel
from uika.viewer.sending import KINDS, exported
from uika.viewer.still import camera_of, compare
from uika.viewer.virtual_camera import VirtualCamera

_FOV = 20.0  # degrees
_PRESETS = {"Front": (0.0, 0.0), "Left": (60.0, 0.0), "Right": (-60.0, 0.0), "Above": (0.0, 50.0), "Back": (180.0, 0.0)}
_STILL = 512  # pixels, the height of a still
_IDLE = 0.005  # seconds between two looks at the controls
_PACE = 1 / 30  # seconds from one update to the next, at least: a browser takes all that come, and may drown in them


class Viewer:
    """A running page; close it with `stop`, or use it as a context."""

    def __init__(
        self,
        avatar: Avatar,
        head: HeadModel,
        motion: Motion | None = None,
        port: int = 8080,
        *,
        camera: LiveFace | None = None,
        frame: Framing = "bust",
        watermark: bool = True,
        virtual_camera: VirtualCamera | None = None,
    ) -> None:
        """Start the server on 127.0.0.1.

        Args:
            avatar: the avatar.
            head: the head model that it was made for.
            motion: a movement to play; None takes the built-in `talk`.
            port: the first port to try.
            camera: whose face the avatar follows; it is stopped with the page.
            frame: what the page's own views show, as in `uika.neutral_camera`.
            watermark: whether pictures that the page renders are marked.
            virtual_camera: where the avatar is also shown; it is stopped with the page.

        Raises:
            AvatarError: the head model is another one.
        """
        avatar.check_head(head)
        try:
            import viser
        except ModuleNotFoundError as error:
            raise UikaError('the viewer needs viser; run: pip install "uika-drjit[view]"') from error
        from uika.motion.presets import get_motion

        self._head, self._camera, self._frame, self._watermark = head, camera, frame, watermark
        self._motion = get_motion("talk", head) if motion is None else motion
        self.live = LiveSplats(avatar, head)
        self.server = viser.ViserServer(host="127.0.0.1", port=port, label="avatar", verbose=False)
        self._virtual = virtual_camera
        self.updates = 0  # poses sent so far
        self._mesh: Any = None
        self._dirty, self._reshaped, self._stopped = threading.Event(), threading.Event(), threading.Event()
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue()
        self._params = HeadParameters.zeros(head)
        self._build()
        self._dirty.set()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def stop(self) -> None:
        """End the threads and the server."""
        self._stopped.set()
        self._thread.join(30)
        if self._camera is not None:
            self._camera.stop()
        if self._virtual is not None:
            self._virtual.stop()
        self.server.stop()

    def __enter__(self) -> Viewer:
        """The viewer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self.stop()

    def _build(self) -> None:
        scene, gui, avatar = self.server.scene, self.server.gui, self.live.avatar
        scene.set_up_direction("+y")
        gui.configure_theme(control_layout="fixed", show_share_button=False)
        buffer, _ = self.live.pose(self._params)
        count = len(avatar)
        centers = buffer[:, :3].copy().view(np.float32)
        white, small = np.ones((count, 3)), np.tile(1e-3 * np.eye(3), (count, 1, 1))
        self._splats = scene.add_gaussian_splats(
            "/avatar", centers=centers, covariances=small, rgbs=white, opacities=white[:, :1]
        )
        self._splats.buffer = buffer
        self._target = target_and_distance(avatar, self._frame)[0]
        self.server.on_client_connect(lambda client: self._look(client, 0.0, 0.0))
        self._status = gui.add_markdown(f"{count:,} Gaussians")
        presets = gui.add_button_group("Camera", tuple(_PRESETS))
        presets.on_click(lambda event: self._look(event.client, *_PRESETS[presets.value]))
        self._pose = PosePanel(gui, self._head, self._moved)
        self._identity = IdentityPanel(gui, avatar.identity, self._reshaped.set)
        self._playing = MotionPanel(gui, self._motion, self._camera, self._dirty.set)
        with gui.add_folder("Display"):
            self._painting = Painting(gui, self.server, self._splats, self._watermark, self._dirty.set)
            colors: Any = gui.add_dropdown("colours", ("photo", "UV"))
            colors.on_update(lambda _: self._jobs.put(lambda: self.live.paint(colors.value)))
            mesh = gui.add_checkbox("mesh", False)
            mesh.on_update(lambda _: self._jobs.put(lambda: self._show_mesh(mesh.value)))
        with gui.add_folder("Still", expand_by_default=False):
            button = gui.add_button("Render with drjit_splat")
            self._verdict = gui.add_markdown("")
            self._still = gui.add_image(torch.ones(8, 8, 3).numpy(), label="rendered", visible=False)
            self._error = gui.add_image(torch.ones(8, 8, 3).numpy(), label="difference x8", visible=False)
        button.on_click(lambda event: self._render(event.client))
        with gui.add_folder("Export", expand_by_default=False):
            for kind in KINDS:
                gui.add_button(kind).on_click(self._sender(kind))

    def _moved(self) -> None:
        self._playing.leave()
        self._dirty.set()

    def _show_mesh(self, shown: bool) -> None:
        if self._mesh is not None:
            self._mesh.remove()
            self._mesh = None
        if shown:
            vertices = self.live.pose(self._params)[1]
            faces = self._head.faces.numpy().astype(np.uint32)
            add = self.server.scene.add_mesh_simple
            self._mesh = add("/mesh", vertices, faces, wireframe=True, color=(40, 40, 40))

    def _look(self, client: Any, yaw: float, pitch: float) -> None:
        camera = neutral_camera(self.live.avatar, yaw, pitch, frame=self._frame)
        with client.atomic():
            client.camera.fov = torch.deg2rad(torch.tensor(_FOV)).item()
            client.camera.up_direction = (0.0, 1.0, 0.0)
            client.camera.position = (camera.position * UNITS).numpy()
            client.camera.look_at = (self._target * UNITS).numpy()

    def _work(self) -> None:
        """Everything that poses or renders, in one thread: the newest state of the controls wins."""
        while not self._stopped.is_set():
            start = time.perf_counter()
            try:
                changed = self._step()
                time.sleep(max(_IDLE, _PACE - (time.perf_counter() - start)) if changed else _IDLE)
            except Exception as error:  # the page goes on, and says what it could not do
                self._status.content = f"**{type(error).__name__}**: {error}"

    def _step(self) -> bool:
        """Do what is to be done; False if nothing was."""
        while not self._jobs.empty():
            self._jobs.get()()
            self._dirty.set()
        if self._reshaped.is_set():
            self._reshaped.clear()
            self.live.reshape(self._identity.identity())
            self._dirty.set()
        camera = self._playing.camera()
        filmed = None if camera is None else camera.newest()
        if filmed is not None or self._playing.advance():
            self._dirty.set()
        if self._virtual is not None:
            self._virtual.keep()
        if not self._dirty.is_set():
            return False
        self._dirty.clear()
        self._params = self._wanted() if filmed is None else filmed
        if self._virtual is not None:
            self._virtual.show(self.live, self._params)
        if self._painting.here:
            self._painting.show(self.live, self._params)
        if not self._painting.here or self._mesh is not None:
            buffer, vertices = self.live.pose(self._params)
        if not self._painting.here:
            self._splats.buffer = buffer
        if self._mesh is not None:
            self._mesh.vertices = vertices
        self.updates += 1
        return True

    def _wanted(self) -> HeadParameters:
        frame = self._playing.frame()
        if frame >= 0:
            return self._motion.parameters(self.live.avatar.identity)[frame]
        return self._pose.controls().parameters(self._head)

    def _render(self, client: Any) -> None:
        """Take the browser's picture here, where waiting is allowed, and leave the rest to the working thread."""
        self._verdict.content = "waiting for the browser"
        camera = client.camera
        view = (camera.wxyz, camera.position, camera.fov)
        width = round(_STILL * camera.aspect)
        mesh = self._mesh
        if mesh is not None:  # the rasterizer draws no mesh
            mesh.visible = False
        try:
            shot = client.get_render(
                _STILL, width, wxyz=view[0], position=view[1], fov=view[2], transport_format="png", timeout=60.0
            )
        except TimeoutError:
            self._verdict.content = "the browser sent no picture within 60 s; try again"
            return
        finally:
            if mesh is not None:
                mesh.visible = True
        self._jobs.put(lambda: self._compare(shot, view))

    def _compare(self, shot: Any, view: Any) -> None:
        picture, difference, decibels = compare(self.live.painted(), self._head, self._params, shot, view)
        self._still.image = to_bytes(mark(picture) if self._watermark else picture)
        self._error.image = to_bytes(difference)
        self._still.visible = self._error.visible = True
        self._verdict.content = f"browser against drjit_splat: {decibels:.1f} dB"

    def _sender(self, kind: str) -> Callable[[Any], None]:
        return lambda event: self._jobs.put(lambda: self._send(event.client, kind))

    def _send(self, client: Any, kind: str) -> None:
        camera = client.camera
        view = (camera.wxyz, camera.position, camera.fov)
        seen = camera_of(view, round(_STILL * camera.aspect), _STILL)
        made = exported(kind, self.live.avatar, self._head, self._params, self._motion, seen, self._watermark)
        client.send_file_download(f"avatar{kind}", made, save_immediately=True)
