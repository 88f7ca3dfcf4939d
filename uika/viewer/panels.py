"""The folders of the page; each holds its controls and knows what they mean."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from torch import Tensor

from uika.head import HeadModel
from uika.motion import Motion
from uika.viewer.controls import Controls, LiveFace, action_groups

_RANGES = {"turn": 60, "nod": 30, "tilt": 30, "gaze_left": 30, "gaze_down": 20}  # degrees
_IDENTITY_SLIDERS = 8
_WIDEST = 3.0  # standard deviations, of identities and of unnamed expressions


class PosePanel:
    """Head pose, jaw, gaze and the actions by part of the face."""

    def __init__(self, gui: Any, head: HeadModel, moved: Callable[[], None]) -> None:
        """Add the folders; `moved` is called whenever a slider was."""
        self._gui, self._moved = gui, moved
        self._pose: dict[str, Any] = {}
        self._actions: dict[str, Any] = {}
        with gui.add_folder("Pose"):
            self._pose["jaw"] = self._slider("jaw", 0.0, 1.0)
            for name, limit in _RANGES.items():
                self._pose[name] = self._slider(name, -float(limit), float(limit), 0.5)
            gui.add_button("Reset").on_click(lambda _: self.reset())
        for title, names in action_groups(head).items():
            with gui.add_folder(title, expand_by_default=False):
                for name in names:
                    self._actions[name] = self._slider(name, -_WIDEST if title == "Expression" else 0.0, 1.0)

    def controls(self) -> Controls:
        """What the sliders say."""
        actions = {name: slider.value for name, slider in self._actions.items()}
        return Controls(**{name: slider.value for name, slider in self._pose.items()}, actions=actions)

    def reset(self) -> None:
        """Back to rest."""
        for slider in (*self._pose.values(), *self._actions.values()):
            slider.value = 0.0
        self._moved()

    def _slider(self, name: str, low: float, high: float, step: float = 0.01) -> Any:
        slider = self._gui.add_slider(name.replace("_", " "), low, high, step, 0.0)
        slider.on_update(lambda _: self._moved())
        return slider


class IdentityPanel:
    """The first modes of the person's shape."""

    def __init__(self, gui: Any, own: Tensor, moved: Callable[[], None]) -> None:
        """Add the folder, at the identity `own` [K]."""
        self._own = own
        self._sliders: list[Any] = []
        with gui.add_folder("Identity", expand_by_default=False):
            for index in range(min(_IDENTITY_SLIDERS, len(own))):
                start = float(own[index].clamp(-_WIDEST, _WIDEST))
                slider = gui.add_slider(f"mode {index + 1}", -_WIDEST, _WIDEST, 0.05, start)
                slider.on_update(lambda _: moved())
                self._sliders.append(slider)
            if self._sliders:
                gui.add_button("The avatar's own").on_click(lambda _: self._reset())

    def identity(self) -> Tensor:
        """[K] as the sliders say."""
        identity = self._own.clone()
        for index, slider in enumerate(self._sliders):
            if abs(slider.value - float(identity[index])) > 0.05:  # the slider's own step changes nothing
                identity[index] = slider.value
        return identity

    def _reset(self) -> None:
        for index, slider in enumerate(self._sliders):
            slider.value = float(self._own[index].clamp(-_WIDEST, _WIDEST))


class MotionPanel:
    """Play, pause and scrub a motion, or follow a camera."""

    def __init__(self, gui: Any, motion: Motion, camera: LiveFace | None, moved: Callable[[], None]) -> None:
        """Add the folder."""
        self._motion, self._camera = motion, camera
        self._frame, self._began = -1, 0.0  # a frame below 0: the sliders count
        with gui.add_folder("Motion"):
            if camera is not None:
                self._follow = gui.add_checkbox("follow the camera", True)
                self._seen = gui.add_markdown(camera.status)
            self._play = gui.add_checkbox("play", False)
            self._scrub = gui.add_slider("frame", 0, max(1, len(motion) - 1), 1, 0)
        self._play.on_update(lambda _: self._start())
        self._scrub.on_update(lambda _: self._show(self._scrub.value, moved))

    def frame(self) -> int:
        """The motion's frame that is shown; below 0 if none is."""
        return min(self._frame, len(self._motion) - 1)

    def leave(self) -> None:
        """Show no frame, but what the sliders say."""
        self._frame = -1

    def advance(self) -> bool:
        """Go on to the frame that is due; False if there is nothing to change."""
        if not self._play.value:
            return False
        place = int((time.perf_counter() - self._began) * self._motion.fps) % len(self._motion)
        if place == self._frame:
            return False
        self._scrub.value = place
        self._frame = place
        return True

    def camera(self) -> LiveFace | None:
        """The camera, if it is to be followed."""
        if self._camera is None:
            return None
        if self._seen.content != self._camera.status:
            self._seen.content = self._camera.status
        return self._camera if self._follow.value else None

    def _show(self, frame: int, moved: Callable[[], None]) -> None:
        self._frame = frame
        moved()

    def _start(self) -> None:
        if self._play.value:
            self._began = time.perf_counter() - max(0, self._frame) / self._motion.fps
