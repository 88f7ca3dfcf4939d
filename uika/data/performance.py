"""How a synthetic person moves, and from where it is seen."""

from __future__ import annotations

import math

import numpy as np
import torch

from uika.head import Camera, HeadModel, HeadParameters, look_at
from uika.motion.presets import EXPRESSIONS, expression_vector

# Yaw and pitch in degrees of the fixed viewpoints, the most useful first; more follow on a spiral.
VIEWPOINTS = ((0, 0), (32, 3), (-32, 3), (62, 0), (-62, 0), (12, 26), (-14, -18), (105, 6), (-105, 6))
_KEY_FRAMES = 4  # frames from one key expression to the next
_JITTER = (4.0, 3.0)  # degrees of yaw and pitch
_TARGET = (0.0, -0.012, -0.03)  # metres, between face and hair
_FIELD = (0.3, 0.4)  # metres of the scene that the frame's height shows at the head
_FOV = (12.0, 26.0)  # degrees
# What the key expressions are made of, besides `uika.motion.presets.EXPRESSIONS`: wilder faces than speech has.
_EXTREMES: tuple[dict[str, float], ...] = (
    {"jawOpen": 0.9, "browInnerUp": 0.9, "browOuterUp": 0.8, "eyeWide": 1.0},
    {"jawOpen": 0.5, "mouthSmile": 1.0, "cheekSquint": 0.9, "mouthUpperUp": 0.5, "mouthLowerDown": 0.4},
    {"browDown": 1.0, "noseSneer": 1.0, "mouthUpperUp": 0.7, "mouthStretch": 0.5, "jawOpen": 0.25},
    {"cheekPuff": 1.0, "mouthPucker": 0.6, "eyeWide": 0.4},
    {"mouthLeft": 0.9, "jawLeft": 0.7, "eyeSquintLeft": 0.8, "browOuterUpRight": 0.8},
    {"mouthRight": 0.9, "jawRight": 0.7, "eyeSquintRight": 0.8, "browOuterUpLeft": 0.8},
    {"mouthFunnel": 1.0, "jawOpen": 0.35, "browInnerUp": 0.5},
    {"mouthRollLower": 0.8, "mouthRollUpper": 0.8, "mouthPress": 0.6, "eyeSquint": 0.6},
    {"eyeBlink": 1.0, "browDown": 0.5, "mouthFrown": 0.7},
    {"mouthShrugLower": 1.0, "mouthFrown": 0.8, "browInnerUp": 0.8},
    {"jawForward": 0.8, "mouthLowerDown": 0.8, "browDown": 0.6},
)


def perform(head: HeadModel, shape: torch.Tensor, frames: int, random: np.random.Generator) -> HeadParameters:
    """Parameters [T] of a person of identity `shape` [K] who pulls faces and looks around.

    The first frame is close to rest; every fourth one is a key expression, with eased passages between them.
    """
    keys = 2 + (frames - 1) // _KEY_FRAMES
    library = [*EXPRESSIONS.values(), *_EXTREMES]
    faces = [0.1 * expression_vector(head, library[random.integers(len(library))])]
    for _ in range(keys - 1):
        first, second = (expression_vector(head, library[random.integers(len(library))]) for _ in range(2))
        mixed = random.uniform(0.6, 1.1) * first + random.uniform(0, 0.5) * second
        faces.append(mixed.clamp(0, 1))
    turns = random.normal(size=(keys, 3)) * np.deg2rad((6.0, 12.0, 4.0))
    necks = random.normal(size=(keys, 3)) * np.deg2rad((4.0, 6.0, 3.0))
    gazes = np.tile(random.normal(size=(keys, 3)) * np.deg2rad((5.0, 10.0, 0.0)), 2)
    shifts = random.normal(size=(keys, 3)) * 0.004
    for track in (turns, necks, gazes):
        track[0] *= 0.2
    place = torch.arange(frames) / _KEY_FRAMES
    before = place.floor().long()
    share = (place - before)[:, None]
    share = share * share * (3 - 2 * share)

    def through(track: np.ndarray | torch.Tensor) -> torch.Tensor:
        values = torch.as_tensor(track).float()
        return torch.lerp(values[before], values[before + 1], share)

    return HeadParameters.zeros(head, frames).replace(
        identity=shape.expand(frames, -1),
        expression=through(torch.stack(faces)),
        rotation=through(turns),
        neck=through(necks),
        eyes=through(gazes),
        translation=through(shifts),
    )


def viewpoints(count: int) -> list[tuple[float, float]]:
    """Yaw and pitch in degrees of the first `count` viewpoints."""
    extra = [(137.508 * k % 360 - 180, 35 * math.sin(1.7 * k)) for k in range(1, count - len(VIEWPOINTS) + 1)]
    return [*VIEWPOINTS, *extra][:count]


def place_camera(view: tuple[float, float], size: int, random: np.random.Generator) -> Camera:
    """A camera near a viewpoint, with a field of view of its own; the head fills most of its frame."""
    yaw, pitch = (angle + random.uniform(-1, 1) * jitter for angle, jitter in zip(view, _JITTER, strict=True))
    fov = random.uniform(*_FOV)
    distance = random.uniform(*_FIELD) / 2 / math.tan(math.radians(fov) / 2)
    return look_at(yaw, pitch, distance, _TARGET, fov_y=fov, size=size)
