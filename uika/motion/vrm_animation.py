"""Animations of VRM avatars, `.vrma` (VRMC_vrm_animation 1.0): a head's rotation, its expressions and its gaze."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.errors import UikaError, UikaWarning
from uika.head import rodrigues
from uika.head.actions import ARKIT_ACTIONS
from uika.io.glb import read_accessor, read_parts
from uika.motion.action_names import find_action
from uika.motion.motion import Motion, MotionError
from uika.motion.recording import axis_angles
from uika.motion.vrm_expressions import PRESETS, actions_of

EXTENSION = "VRMC_vrm_animation"
FPS = 30.0  # the file has keys at times of its own
_LONGEST = 3600.0  # seconds
_RESTING = ("neutral",)  # a preset without a movement
Array = NDArray[np.float64]


def read_vrma(path: str | Path) -> Motion:
    """The head's part of a VRM animation, 30 frames a second, in the order of `ARKIT_ACTIONS`.

    The bone `head`, with all bones above it, turns the head about its neck; where the hips look in the first frame is
    straight ahead. Presets become ARKit actions (`vrm_expressions`), custom expressions count if they bear the name of
    one; weights are clamped to [0,1] as VRM has it. The gaze turns both eyes.

    Raises:
        MotionError: the file is missing, damaged, or holds no animation of a VRM avatar.
    """
    place = Path(path)
    try:
        document, binary = read_parts(place)
        clip = _Clip(document, binary)
        motion, strange = clip.motion()
    except UikaError as error:
        text = str(error)
        raise MotionError(text if text.startswith(str(place)) else f"{place}: {text}") from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise MotionError(f"{place}: cannot be read as a VRM animation ({error})") from error
    if strange:
        warnings.warn(f"{place}: leaves out expressions that no ARKit action bears: {strange}", UikaWarning, 2)
    return motion


class _Clip:
    """The first animation of a document."""

    def __init__(self, document: dict[str, Any], binary: bytes) -> None:
        self.roles = document.get("extensions", {}).get(EXTENSION)
        if not isinstance(self.roles, dict) or not document.get("animations"):
            raise MotionError(f"holds no animation of a VRM avatar ({EXTENSION})")
        self.nodes: list[dict[str, Any]] = document["nodes"]
        self.parents = {child: index for index, node in enumerate(self.nodes) for child in node.get("children", ())}
        animation = document["animations"][0]
        self.keys: dict[tuple[int, str], tuple[Array, Array, str]] = {}
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            times, values = (read_accessor(document, binary, sampler[end]).astype(float) for end in ("input", "output"))
            way = sampler.get("interpolation", "LINEAR")
            if way == "CUBICSPLINE":  # the keys without their tangents
                values = values[1::3]
            if not len(times) or len(values) != len(times) or (np.diff(times[:, 0]) < 0).any():
                raise MotionError("has keys without times, or times that fall")
            self.keys[target.get("node", -1), target["path"]] = times[:, 0], values, way
        last = max((float(times[-1]) for times, _, _ in self.keys.values()), default=0.0)
        if not 0 <= last <= _LONGEST:
            raise MotionError(f"lasts {last:g} seconds; at most {_LONGEST:g} can be read")
        self.times = np.arange(int(last * FPS + 1e-6) + 1) / FPS

    def motion(self) -> tuple[Motion, str]:
        """The motion, and the names of expressions that are left out."""
        bones = self.roles.get("humanoid", {}).get("humanBones", {})
        count = len(self.times)
        still = torch.zeros(count, 3)
        neck = still
        if "head" in bones:
            world = self._turned(bones["head"]["node"])
            ahead = self._turned(bones["hips"]["node"])[:1] if "hips" in bones else torch.eye(3).double()[None]
            neck = axis_angles(ahead.mT @ world).float()
        eyes = torch.zeros(count, 6)
        if "lookAt" in self.roles:
            eyes = axis_angles(self._local(self.roles["lookAt"]["node"])).float().repeat(1, 2)
        expression, strange = self._expressions()
        return Motion(expression, still, neck, still, eyes, still, FPS), strange

    def _expressions(self) -> tuple[Tensor, str]:
        table, strange = np.zeros((len(self.times), len(ARKIT_ACTIONS))), []
        kinds = self.roles.get("expressions", {})
        for kind in ("preset", "custom"):
            for name, where in kinds.get(kind, {}).items():
                weights = self._weights(where["node"])
                if kind == "preset" and name in PRESETS:
                    actions = actions_of(name, ARKIT_ACTIONS)
                elif (found := find_action(name)) in ARKIT_ACTIONS:
                    actions = {str(found): 1.0}
                else:
                    strange += [] if name in _RESTING else [name]
                    continue
                for action, weight in actions.items():
                    table[:, ARKIT_ACTIONS.index(action)] += weight * weights
        return torch.from_numpy(table.clip(0, 1)).float(), ", ".join(strange)

    def _weights(self, node: int) -> Array:
        """An expression's weight [T] is the X of its node."""
        if (node, "translation") not in self.keys:
            return np.full(len(self.times), float(self.nodes[node].get("translation", (0.0,))[0]))
        times, values, way = self.keys[node, "translation"]
        if way == "STEP":
            return values[np.searchsorted(times, self.times, "right").clip(1) - 1, 0].clip(0, 1)
        return np.interp(self.times, times, values[:, 0]).clip(0, 1)

    def _turned(self, node: int) -> Tensor:
        """How a bone stands in the world beside its rest pose, rotations [T,3,3]."""
        world = rest = torch.eye(3, dtype=torch.float64)
        chain = [node]
        while (parent := self.parents.get(chain[-1], -1)) >= 0:
            if parent in chain:
                raise MotionError("has bones that are their own parents")
            chain.append(parent)
        for bone in reversed(chain):
            world, rest = world @ self._local(bone), rest @ self._rest(bone)
        return world @ rest.mT

    def _rest(self, node: int) -> Tensor:
        return _matrices(np.array([self.nodes[node].get("rotation", (0.0, 0.0, 0.0, 1.0))], dtype=float))[0]

    def _local(self, node: int) -> Tensor:
        """A node's own rotations [T,3,3]."""
        if (node, "rotation") not in self.keys:
            return self._rest(node).expand(len(self.times), 3, 3)
        times, quats, way = self.keys[node, "rotation"]
        after = np.searchsorted(times, self.times, "right").clip(0, len(times) - 1)
        before = (np.searchsorted(times, self.times, "right") - 1).clip(0)
        span = times[after] - times[before]
        share = np.where(span > 0, (self.times - times[before]) / np.where(span > 0, span, 1), 0).clip(0, 1)
        return _matrices(_slerp(quats[before], quats[after], share * (way != "STEP")))


def _slerp(one: Array, other: Array, share: Array) -> Array:
    """Quaternions [T,4] between two others on the shorter arc; a share [T] of 0 is the first."""
    one, other = (q / np.linalg.norm(q, axis=-1, keepdims=True).clip(1e-12) for q in (one, other))
    cosine = (one * other).sum(-1)
    other, cosine = other * np.where(cosine < 0, -1, 1)[:, None], np.abs(cosine).clip(0, 1)
    angle = np.arccos(cosine)
    near = angle < 1e-6
    sine = np.where(near, 1, np.sin(angle))
    a = np.where(near, 1 - share, np.sin((1 - share) * angle) / sine)
    b = np.where(near, share, np.sin(share * angle) / sine)
    return a[:, None] * one + b[:, None] * other


def _matrices(xyzw: Array) -> Tensor:
    """Rotations [T,3,3] of quaternions [T,4] in glTF's order."""
    length = np.linalg.norm(xyzw, axis=-1, keepdims=True)
    if (length < 1e-6).any():
        raise MotionError("has a rotation of length zero")
    vector, scalar = torch.from_numpy(xyzw / length).split((3, 1), -1)
    sine = vector.norm(dim=-1, keepdim=True)
    return rodrigues(2 * vector / sine.clamp_min(1e-12) * torch.atan2(sine, scalar))
