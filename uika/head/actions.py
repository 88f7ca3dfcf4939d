"""The 52 facial actions that phones and capture programs speak (ARKit blend shape locations)."""

from __future__ import annotations

from uika.head.model import HeadModel

# In the order of Live Link Face files, without the head and eye rotations.
ARKIT_ACTIONS = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft",
    "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight", "eyeLookUpRight",
    "eyeSquintRight", "eyeWideRight", "jawForward", "jawRight", "jawLeft", "jawOpen", "mouthClose", "mouthFunnel",
    "mouthPucker", "mouthRight", "mouthLeft", "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft",
    "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft", "mouthPressRight",
    "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft",
    "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft",
    "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut",
)  # fmt: skip


def has_actions(head: HeadModel) -> bool:
    """Whether the head's expressions are facial actions, activations in [0,1], rather than abstract components."""
    return set(ARKIT_ACTIONS) <= set(head.expression_names)


def fitted_joints(head: HeadModel) -> tuple[int, ...]:
    """Joints that a face's look depends on beyond its expression: jaw and eyes, where no action stands for them."""
    names = head.expression_names
    jaw = () if "jawOpen" in names else (2,)
    return jaw if "eyeLookInLeft" in names else (*jaw, 3, 4)
