"""The spellings of ARKit's actions in files of other programs."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from uika.head.actions import ARKIT_ACTIONS
from uika.motion.motion import MotionError

HEAD_ANGLES = ("headYaw", "headPitch", "headRoll")
# What stands beside the actions in recordings and moves no part of the face: counters, and the gaze that the eyeLook
# actions repeat.
_BESIDE = frozenset(
    (
        "timecode", "blendshapecount", "time", "timestamp", "timestampms", "seconds", "frame", "frameindex",
        "framenumber", "index", "fps", "neutral",
        *(f"{side}eye{turn}" for side in ("left", "right") for turn in ("yaw", "pitch", "roll")),
        *(f"eye{turn}{side}" for side in ("left", "right") for turn in ("yaw", "pitch", "roll")),
    )
)  # fmt: skip
_SHOWN = 5


def _bare(name: str) -> str:
    """Letters and digits in lower case, without the object before the last dot or colon."""
    return re.sub(r"[^a-z0-9]", "", re.split(r"[.:|]", name.strip())[-1].lower())


def _spellings() -> dict[str, str]:
    known = {_bare(name): name for name in (*ARKIT_ACTIONS, *HEAD_ANGLES)}
    for name in ARKIT_ACTIONS:
        for side in ("Left", "Right"):
            if name.endswith(side):
                base = _bare(name.removesuffix(side))
                known[base + side[0].lower()] = name  # Apple's own constants are spelled eyeBlink_L
                known[side.lower() + base] = name
    return known


_SPELLINGS = _spellings()


def find_action(name: str) -> str | None:
    """The action or head angle that a name of another program means, or None.

    Capitals, underscores, spaces and an object's name in front do not matter; sides may be written Left, L or _L.
    """
    return _SPELLINGS.get(_bare(name))


def find_actions(names: Iterable[str]) -> dict[str, str]:
    """File's name -> action or head angle, for each name that means one; columns of time and gaze are left out.

    Raises:
        MotionError: none is an action, some are not understood, or two mean the same; the message lists them.
    """
    found: dict[str, str] = {}
    strange: list[str] = []
    for name in names:
        action = find_action(name)
        if action is not None:
            if action in found.values():
                twin = next(other for other, known in found.items() if known == action)
                raise MotionError(f"names the action {action} twice: {_quoted(twin)} and {_quoted(name)}; keep one")
            found[name] = action
        elif _bare(name) not in _BESIDE:
            strange.append(name)
    if not set(found.values()) & set(ARKIT_ACTIONS):
        raise MotionError("names no ARKit actions such as jawOpen")
    if strange:
        shown = ", ".join(_quoted(name) + _guess(name) for name in strange[:_SHOWN])
        more = f" and {len(strange) - _SHOWN} more" if len(strange) > _SHOWN else ""
        raise MotionError(f"names what is no ARKit action: {shown}{more}; rename or remove it")
    return found


def _guess(name: str) -> str:
    near = difflib.get_close_matches(_bare(name)[:40], _SPELLINGS, n=1, cutoff=0.8)
    return f" (meant {_SPELLINGS[near[0]]}?)" if near else ""


def _quoted(name: str) -> str:
    return repr(name if len(name) <= 40 else name[:37] + "...")
