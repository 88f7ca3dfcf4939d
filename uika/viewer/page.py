"""The page: its controls, and the thread that poses what they ask for."""

from __future__ import annotations

import queue
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import HeadModel, HeadParameters
from uika.motion import Motion
from uika.rendering import neutral_camera
from uika.viewer.controls import Controls, action_groups
from uika.viewer.live import UNITS, LiveSplats
from uika.viewer.still import compare

_FOV = 20.0  # degrees
_PRESETS = {"Front": (0.0, 0.0), "Left": (60.0, 0.0), "Right": (-60.0, 0.0), "Above": (0.0, 50.0), "Back": (180.0, 0.0)}
_IDENTITY_SLIDERS = 8
_EXPORTS = (".ply", ".splat", ".glb", ".html")
_STILL = 512  # pixels, the height of a still
_IDLE = 0.005  # seconds between two looks at the controls


class Viewer:
    """A running page; close it with `stop`, or use it as a context."""

    def __init__(self, avatar: Avatar, head: HeadModel, motion: Motion | None = None, port: int = 8080) -> None:
        """Start the server on 127.0.0.1.

        Args:
            avatar: the avatar.
            head: the head model that it was made for.
            motion: a movement to play.
            port: the first port to try.

        Raises:
            AvatarError: the head model is another one.
        """
        avatar.check_head(head)
        try:
            import viser
        except ModuleNotFoundError as error:
            raise UikaError('the viewer needs viser; run: pip install "uika-drjit[view]"') from error
        self._head, self._motion = head, motion
        self.live = LiveSplats(avatar, head)
        self.server = viser.ViserServer(host="127.0.0.1", port=port, label="avatar", verbose=False)
        self.updates = 0  # poses sent so far
        self._actions: dict[str, Any] = {}
        self._pose: dict[str, Any] = {}
        self._identity: list[Any] = []
        self._mesh: Any = None
        self._play: Any = None
        self._scrub: Any = None
        self._dirty, self._stopped = threading.Event(), threading.Event()
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue()
        self._frame, self._began = -1, 0.0
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
        """End the thread and the server."""
        self._stopped.set()
        self._thread.join(30)
        self.server.stop()

    def __enter__(self) -> Viewer:
        """The viewer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self.stop()

    def _build(self) -> None:
        scene, gui = self.server.scene, self.server.gui
        scene.set_up_direction("+y")
        gui.configure_theme(control_layout="fixed", show_share_button=False)
        buffer, _ = self.live.pose(self._params)
        count = len(self.live.avatar)
        centers = buffer[:, :3].copy().view(np.float32)
        white, small = np.ones((count, 3)), np.tile(1e-3 * np.eye(3), (count, 1, 1))
        self._splats = scene.add_gaussian_splats(
            "/avatar", centers=centers, covariances=small, rgbs=white, opacities=white[:, :1]
        )
        self._splats.buffer = buffer
        camera = neutral_camera(self.live.avatar)
        self._target = torch.quantile(self.live.avatar.means, torch.tensor([0.002, 0.998]), dim=0).mean(0)
        self._distance = float((camera.position - self._target).norm())
        self.server.on_client_connect(lambda client: self._look(client, 0.0, 0.0))
        self._status = gui.add_markdown(f"{count:,} Gaussians")
        presets = gui.add_button_group("Camera", tuple(_PRESETS))
        presets.on_click(lambda event: self._look(event.client, *_PRESETS[presets.value]))
        self._build_pose()
        self._build_motion()
        self._build_display()

    def _build_pose(self) -> None:
        gui = self.server.gui
        ranges = {"turn": 60, "nod": 30, "tilt": 30, "gaze_left": 30, "gaze_down": 20}
        with gui.add_folder("Pose"):
            self._pose["jaw"] = self._slider("jaw", 0.0, 1.0)
            for name, limit in ranges.items():
                self._pose[name] = self._slider(name, -float(limit), float(limit), 0.5)
            gui.add_button("Reset").on_click(lambda _: self._reset())
        for title, names in action_groups(self._head).items():
            with gui.add_folder(title, expand_by_default=False):
                for name in names:
                    self._actions[name] = self._slider(name, 0.0 if title != "Expression" else -3.0, 1.0)
        with gui.add_folder("Identity", expand_by_default=False):
            own = self.live.avatar.identity
            for index in range(min(_IDENTITY_SLIDERS, len(own))):
                slider = gui.add_slider(f"mode {index + 1}", -3.0, 3.0, 0.05, float(own[index].clamp(-3, 3)))
                slider.on_update(lambda _: self._jobs.put(self._reshape))
                self._identity.append(slider)

    def _build_motion(self) -> None:
        gui = self.server.gui
        if self._motion is None:
            return
        with gui.add_folder("Motion"):
            self._play = gui.add_checkbox("play", False)
            self._scrub = gui.add_slider("frame", 0, max(1, len(self._motion) - 1), 1, 0)
        self._play.on_update(lambda _: self._start())
        self._scrub.on_update(lambda _: self._dirty.set())
        self._scrub.on_update(lambda _: setattr(self, "_frame", self._scrub.value))

    def _build_display(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Display"):
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
            for kind in _EXPORTS:
                gui.add_button(kind).on_click(self._sender(kind))

    def _slider(self, name: str, low: float, high: float, step: float = 0.01) -> Any:
        slider = self.server.gui.add_slider(name.replace("_", " "), low, high, step, 0.0)
        slider.on_update(lambda _: self._moved())
        return slider

    def _moved(self) -> None:
        self._frame = -1
        self._dirty.set()

    def _reset(self) -> None:
        for slider in (*self._pose.values(), *self._actions.values()):
            slider.value = 0.0
        self._moved()

    def _show_mesh(self, shown: bool) -> None:
        if self._mesh is not None:
            self._mesh.remove()
            self._mesh = None
        if shown:
            vertices = self.live.pose(self._params)[1]
            faces = self._head.faces.numpy().astype(np.uint32)
            add = self.server.scene.add_mesh_simple
            self._mesh = add("/mesh", vertices, faces, wireframe=True, color=(40, 40, 40))

    def _start(self) -> None:
        if self._motion is not None and self._play is not None and self._play.value:
            self._began = time.perf_counter() - max(0, self._frame) / self._motion.fps

    def _look(self, client: Any, yaw: float, pitch: float) -> None:
        camera = neutral_camera(self.live.avatar, yaw, pitch)
        with client.atomic():
            client.camera.fov = torch.deg2rad(torch.tensor(_FOV)).item()
            client.camera.up_direction = (0.0, 1.0, 0.0)
            client.camera.position = (camera.position * UNITS).numpy()
            client.camera.look_at = (self._target * UNITS).numpy()

    def _reshape(self) -> None:
        identity = self.live.avatar.identity.clone()
        values = [slider.value for slider in self._identity]
        if values == identity[: len(values)].tolist():
            return  # a later slider's job has done it already
        identity[: len(values)] = torch.tensor(values)
        self.live.reshape(identity)

    def _work(self) -> None:
        """Everything that poses or renders, in one thread: the newest state of the controls wins."""
        while not self._stopped.is_set():
            while not self._jobs.empty():
                self._jobs.get()()
                self._dirty.set()
            if self._motion is not None and self._play is not None and self._play.value:
                place = int((time.perf_counter() - self._began) * self._motion.fps) % len(self._motion)
                if place != self._frame:
                    self._scrub.value = place
                    self._frame = place
                    self._dirty.set()
            if not self._dirty.is_set():
                time.sleep(_IDLE)
                continue
            self._dirty.clear()
            self._params = self._wanted()
            buffer, vertices = self.live.pose(self._params)
            self._splats.buffer = buffer
            if self._mesh is not None:
                self._mesh.vertices = vertices
            self.updates += 1

    def _wanted(self) -> HeadParameters:
        if self._motion is not None and self._frame >= 0:
            return self._motion.parameters(self.live.avatar.identity)[min(self._frame, len(self._motion) - 1)]
        actions = {name: slider.value for name, slider in self._actions.items()}
        return Controls(**{name: slider.value for name, slider in self._pose.items()}, actions=actions).parameters(
            self._head
        )

    def _render(self, client: Any) -> None:
        """Take the browser's picture here, where waiting is allowed, and leave the rest to the working thread."""
        self._verdict.content = "waiting for the browser"
        camera = client.camera
        view = (camera.wxyz, camera.position, camera.fov)
        width = round(_STILL * camera.aspect)
        shot = client.get_render(
            _STILL, width, wxyz=view[0], position=view[1], fov=view[2], transport_format="png", timeout=60.0
        )
        self._jobs.put(lambda: self._compare(shot, view))

    def _compare(self, shot: Any, view: Any) -> None:
        picture, difference, decibels = compare(self.live.avatar, self._head, self._params, shot, view)
        self._still.image, self._error.image = picture, difference
        self._still.visible = self._error.visible = True
        self._verdict.content = f"browser against drjit_splat: {decibels:.1f} dB"

    def _sender(self, kind: str) -> Callable[[Any], None]:
        return lambda event: self._jobs.put(lambda: self._send(event, kind))

    def _send(self, event: Any, kind: str) -> None:
        from uika import export

        avatar = self.live.avatar
        splats = export.posed_splats(avatar, self._head, self._params)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"avatar{kind}"
            if kind == ".ply":
                export.write_ply(path, splats.half_turned(), avatar.provenance)
            elif kind == ".splat":
                export.write_splat(path, splats.half_turned())
            elif kind == ".glb":
                export.write_glb(path, splats, avatar.provenance)
            else:
                from uika.acting import get_motion

                export.write_html(path, avatar, self._motion or get_motion("talk", self._head), self._head)
            event.client.send_file_download(path.name, path.read_bytes())
