"""The expressions of VRM 1.0 in ARKit's actions."""

from __future__ import annotations

from collections.abc import Collection

# A name without side stands for both sides.
PRESETS: dict[str, dict[str, float]] = {
    "happy": {"mouthSmile": 0.8, "cheekSquint": 0.4},
    "angry": {"browDown": 0.9, "noseSneer": 0.4, "mouthPress": 0.3},
    "sad": {"browInnerUp": 0.8, "mouthFrown": 0.7},
    "relaxed": {"mouthSmile": 0.3, "eyeSquint": 0.3},
    "surprised": {"browInnerUp": 0.8, "browOuterUp": 0.8, "eyeWide": 0.7, "jawOpen": 0.4},
    "aa": {"jawOpen": 0.6},
    "ih": {"jawOpen": 0.2, "mouthStretch": 0.5, "mouthSmile": 0.2},
    "ou": {"jawOpen": 0.15, "mouthPucker": 0.8},
    "ee": {"jawOpen": 0.25, "mouthSmile": 0.4, "mouthStretch": 0.3},
    "oh": {"jawOpen": 0.4, "mouthFunnel": 0.6},
    "blink": {"eyeBlink": 1.0},
    "blinkLeft": {"eyeBlinkLeft": 1.0},
    "blinkRight": {"eyeBlinkRight": 1.0},
    "lookUp": {"eyeLookUp": 1.0},
    "lookDown": {"eyeLookDown": 1.0},
    "lookLeft": {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
    "lookRight": {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0},
}


def actions_of(preset: str, known: Collection[str]) -> dict[str, float]:
    """Action -> weight of one preset, sides spelled out, of those actions that are known.

    Raises:
        KeyError: VRM has no such preset.
    """
    return {
        full: weight
        for action, weight in PRESETS[preset].items()
        for full in (action, f"{action}Left", f"{action}Right")
        if full in known
    }
