"""Photos in, an animatable 3D Gaussian head out.

`reconstruct` makes an `Avatar` from photos, `get_motion` finds a `Motion`, `render` and `frames` make pictures of it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from uika._version import __version__

if TYPE_CHECKING:
    from uika.avatar import Avatar, AvatarError
    from uika.avatar.framing import neutral_camera
    from uika.avatar.rendering import Rendering, frames, render
    from uika.errors import UikaError
    from uika.head import Camera, HeadModel, HeadParameters, load_head
    from uika.io.sound import Sound, read_sound
    from uika.io.video import write_png, write_video
    from uika.motion import Motion, MotionError, load_motion
    from uika.motion.presets import get_motion
    from uika.motion.speech import speech
    from uika.motion.voice import say
    from uika.reconstruction import GrowingAvatar, Reconstruction, reconstruct

_HOMES = {
    "Avatar": "avatar",
    "AvatarError": "avatar",
    "Camera": "head",
    "GrowingAvatar": "reconstruction",
    "HeadModel": "head",
    "HeadParameters": "head",
    "Motion": "motion",
    "MotionError": "motion",
    "Reconstruction": "reconstruction",
    "Rendering": "avatar.rendering",
    "Sound": "io.sound",
    "UikaError": "errors",
    "frames": "avatar.rendering",
    "get_motion": "motion.presets",
    "load_head": "head",
    "load_motion": "motion",
    "neutral_camera": "avatar.framing",
    "read_sound": "io.sound",
    "reconstruct": "reconstruction",
    "render": "avatar.rendering",
    "say": "motion.voice",
    "speech": "motion.speech",
    "write_png": "io.video",
    "write_video": "io.video",
}

__all__ = [
    "Avatar",
    "AvatarError",
    "Camera",
    "GrowingAvatar",
    "HeadModel",
    "HeadParameters",
    "Motion",
    "MotionError",
    "Reconstruction",
    "Rendering",
    "Sound",
    "UikaError",
    "__version__",
    "frames",
    "get_motion",
    "load_head",
    "load_motion",
    "neutral_camera",
    "read_sound",
    "reconstruct",
    "render",
    "say",
    "speech",
    "write_png",
    "write_video",
]


def __getattr__(name: str) -> Any:
    # Loading torch takes longer than looking at a name should.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
