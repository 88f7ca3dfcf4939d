"""The motions that come with the program: `orbit`, `talk` and `expressions`, computed from a few key poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from uika.head import HeadModel
from uika.motion.motion import Motion, MotionError
from uika.motion.read import KINDS, read_motion

Actions = Mapping[str, float]  # ARKit action -> activation; a name without side stands for both sides

_VISEMES: dict[str, Actions] = {
    "_": {"jawOpen": 0.03},
    "a": {"jawOpen": 0.42, "mouthLowerDown": 0.25, "mouthUpperUp": 0.15},
    "e": {"jawOpen": 0.24, "mouthStretch": 0.3, "mouthSmile": 0.2, "mouthUpperUp": 0.2},
    "i": {"jawOpen": 0.12, "mouthStretch": 0.4, "mouthSmile": 0.25, "mouthUpperUp": 0.25, "mouthLowerDown": 0.2},
    "o": {"jawOpen": 0.3, "mouthFunnel": 0.55},
    "u": {"jawOpen": 0.1, "mouthPucker": 0.65, "mouthFunnel": 0.2},
    "m": {"mouthPress": 0.45, "mouthRollLower": 0.3, "mouthRollUpper": 0.25},
    "f": {"jawOpen": 0.08, "mouthRollLower": 0.5, "mouthUpperUp": 0.3},
    "l": {"jawOpen": 0.2, "mouthLowerDown": 0.2, "mouthStretch": 0.1},
    "s": {"jawOpen": 0.05, "mouthStretch": 0.25, "mouthUpperUp": 0.2, "mouthLowerDown": 0.3},
}
# (seconds, viseme) of "hello ... I am alive, and moving now": when each mouth shape is reached.
_SPEECH = (
    (0.0, "_"), (0.16, "_"), (0.26, "e"), (0.36, "l"), (0.5, "o"), (0.66, "u"), (0.82, "_"),
    (0.94, "a"), (1.04, "i"), (1.16, "a"), (1.28, "m"), (1.38, "a"), (1.48, "l"), (1.6, "a"), (1.7, "i"),
    (1.8, "f"), (1.96, "_"), (2.06, "a"), (2.16, "s"), (2.26, "m"), (2.38, "u"), (2.48, "f"), (2.58, "i"),
    (2.68, "s"), (2.8, "a"), (2.94, "o"), (3.06, "u"), (3.24, "_"), (3.4, "_"),
)  # fmt: skip
_SPEECH_SECONDS = 3.4
_BLINKS = (0.78, 2.02)  # seconds, lids shut
_GAZE = (
    (0.0, 0.0, 0.0),
    (0.62, 0.13, -0.03),
    (1.2, -0.02, 0.02),
    (1.98, -0.14, 0.03),
    (2.62, 0.02, 0.0),
    (3.2, 0.0, 0.0),
)
_SACCADE = 0.12  # seconds
_BLINK_WIDTH = 0.075  # seconds

# Name -> (actions, gaze). Faces that a photo sheet can show one by one.
EXPRESSIONS: dict[str, Actions] = {
    "smile": {"mouthSmile": 0.7, "cheekSquint": 0.35, "eyeSquint": 0.3, "mouthUpperUp": 0.2, "mouthDimple": 0.2},
    "surprise": {"jawOpen": 0.5, "browInnerUp": 0.8, "browOuterUp": 0.8, "eyeWide": 0.7, "mouthFunnel": 0.2},
    "frown": {"browDown": 0.8, "mouthFrown": 0.7, "eyeSquint": 0.3, "mouthShrugLower": 0.4, "noseSneer": 0.3},
    "kiss": {"mouthPucker": 0.8, "mouthFunnel": 0.15, "browInnerUp": 0.2},
    "wink": {
        "eyeBlinkLeft": 0.95,
        "cheekSquintLeft": 0.5,
        "mouthSmileLeft": 0.5,
        "mouthSmileRight": 0.2,
        "browOuterUpRight": 0.3,
    },
}
_FACE_SECONDS = 1.2
_EASE = 0.4  # seconds in and out of each face
_ORBIT_SECONDS = 4.0
_ORBIT_YAW, _ORBIT_PITCH = 55.0, 8.0  # degrees


def expression_vector(head: HeadModel, actions: Actions) -> Tensor:
    """Activations [E] of named actions; a name without Left or Right moves both sides, unknown names are left out."""
    result = torch.zeros(len(head.expression_names))
    for name, amount in actions.items():
        for full in (name, f"{name}Left", f"{name}Right"):
            if full in head.expression_names:
                result[head.expression_names.index(full)] = amount
    return result


def orbit(head: HeadModel, fps: float = 25.0) -> Motion:
    """A still face and a camera that swings once around it, 4 s, ending where it starts."""
    time = _times(_ORBIT_SECONDS, fps)
    phase = 2 * math.pi * time / _ORBIT_SECONDS
    return _motion(head, fps, len(time), yaw=_ORBIT_YAW * torch.sin(phase), pitch=_ORBIT_PITCH * torch.sin(2 * phase))


def talk(head: HeadModel, fps: float = 25.0) -> Motion:
    """A short sentence with blinks, glances and a slightly moving head, 3.4 s, ending at rest as it starts."""
    time = _times(_SPEECH_SECONDS, fps)
    shapes = torch.stack([expression_vector(head, _VISEMES[viseme]) for _, viseme in _SPEECH])
    expression = _through([at for at, _ in _SPEECH], shapes, time)
    expression += _loudness(time)[:, None] * expression_vector(head, {"browInnerUp": 0.25, "browOuterUp": 0.15})
    shut = torch.stack([torch.exp(-(((time - at) / _BLINK_WIDTH) ** 2)) for at in _BLINKS]).amax(0)
    expression = torch.maximum(expression, shut[:, None] * expression_vector(head, {"eyeBlink": 1.0}))
    phase = 2 * math.pi * time / _SPEECH_SECONDS
    # Whole numbers of swings keep the end equal to the start; the smooth gate starts them from rest.
    gate = torch.sin(phase / 2).clamp_min(0)
    nod = gate * (0.025 * torch.sin(3 * phase) + 0.02 * _loudness(time))
    turn = gate * 0.06 * torch.sin(phase)
    tilt = gate * 0.03 * torch.sin(2 * phase)
    return _motion(head, fps, len(time), expression, neck=torch.stack((nod, turn, tilt), -1), eyes=_gaze(time))


def expressions(head: HeadModel, fps: float = 25.0) -> Motion:
    """One face after the other (`EXPRESSIONS`), 1.2 s each, eased in and out of a resting face."""
    local = torch.arange(round(_FACE_SECONDS * fps)) / fps
    ease = _smooth(local / _EASE) * _smooth((_FACE_SECONDS - local) / _EASE)
    faces = [ease[:, None] * expression_vector(head, actions) for actions in EXPRESSIONS.values()]
    expression = torch.cat((*faces, torch.zeros(1, len(head.expression_names))))
    return _motion(head, fps, len(expression), expression)


MOTIONS: dict[str, Callable[[HeadModel, float], Motion]] = {"orbit": orbit, "talk": talk, "expressions": expressions}


def get_motion(name: str, head: HeadModel, fps: float | None = None, source: HeadModel | None = None) -> Motion:
    """A built-in motion by name, or the motion file at that path.

    Args:
        name: "orbit", "talk", "expressions", or the path of a motion for `uika.motion.read_motion`.
        head: the head model to move.
        fps: frames per second; None means 25 for the built-in motions and the file's own rate.
        source: the FLAME head that FLAME parameters belong to, if `head` is none.

    Raises:
        MotionError: there is no such motion or file, the file cannot be used, or `fps` is out of range.
    """
    if fps is not None and not 1 <= fps <= 240:
        raise MotionError(f"fps must lie between 1 and 240, not {fps:g}")
    if name in MOTIONS:
        return MOTIONS[name](head, 25.0 if fps is None else fps)
    if Path(name).suffix.lower() not in KINDS and not Path(name).is_dir():
        kinds = ", ".join(KINDS)
        raise MotionError(f"{name}: is neither a built-in motion ({', '.join(MOTIONS)}) nor a motion file ({kinds})")
    motion = read_motion(name, head, source)
    return motion if fps is None else motion.resampled(fps)


def _times(seconds: float, fps: float) -> Tensor:
    return torch.arange(max(1, round(seconds * fps))) / fps


def _motion(head: HeadModel, fps: float, count: int, expression: Tensor | None = None, **tensors: Tensor) -> Motion:
    if expression is None:
        expression = torch.zeros(count, len(head.expression_names))
    sizes = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    rest = {name: torch.zeros(count, size) for name, size in sizes.items()}
    return Motion(expression=expression, fps=fps, **{**rest, **tensors})


def _smooth(share: Tensor) -> Tensor:
    """Rise from 0 to 1 without a jolt (smoothstep) as `share` goes from 0 to 1."""
    share = share.clamp(0, 1)
    return share * share * (3 - 2 * share)


def _through(at: Sequence[float], values: Tensor, time: Tensor) -> Tensor:
    """Values [N,C] reached at the times `at` [N], eased from each to the next, at the times [T]."""
    keys = torch.tensor(at)
    after = torch.searchsorted(keys, time, right=True).clamp(1, len(keys) - 1)
    share = _smooth((time - keys[after - 1]) / (keys[after] - keys[after - 1]))
    return torch.lerp(values[after - 1], values[after], share[:, None])


def _loudness(time: Tensor) -> Tensor:
    """Stress [T] in [0,1] of the stressed syllables."""
    return torch.stack([torch.exp(-(((time - at) / 0.22) ** 2)) for at in (0.5, 1.55, 2.8)]).amax(0)


def _gaze(time: Tensor) -> Tensor:
    """Both eyes [T,6] jump together between fixations (seconds, radians to the left, radians down)."""
    result = torch.zeros(len(time), 2)
    for (_, left_before, down_before), (at, left, down) in pairwise(_GAZE):
        step = torch.tensor([down - down_before, left - left_before])
        result = result + _smooth((time - at) / _SACCADE)[:, None] * step
    one = torch.cat((result, torch.zeros(len(time), 1)), -1)
    return torch.cat((one, one), -1)
