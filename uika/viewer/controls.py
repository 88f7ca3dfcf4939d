"""What the sliders mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import torch

from uika.head import HeadModel, HeadParameters

# Group -> beginnings of action names, the first that fits.
_GROUPS = {"Brows": ("brow",), "Eyes": ("eye",), "Jaw and tongue": ("jaw", "tongue"), "Mouth": ("mouth",)}
_OTHERS = "Cheeks and nose"
_JAW_RADIANS = 0.35  # of a jaw joint that is wide open


class LiveFace(Protocol):
    """What brings a face live: a camera, or packets of a phone."""

    @property
    def status(self) -> str:
        """What is going on, for the user."""

    def newest(self) -> HeadParameters | None:
        """The newest pose; None if it was handed out before."""

    def stop(self) -> None:
        """End it."""


@dataclass(frozen=True)
class Controls:
    """The state of all sliders; angles are in degrees."""

    turn: float = 0.0  # head to the subject's left
    nod: float = 0.0  # head down
    tilt: float = 0.0  # head towards the subject's right shoulder
    jaw: float = 0.0  # open, in [0,1]
    gaze_left: float = 0.0
    gaze_down: float = 0.0
    actions: Mapping[str, float] = field(default_factory=dict)  # activations by name

    def parameters(self, head: HeadModel) -> HeadParameters:
        """The pose of one frame; the identity is left at zero, an avatar keeps its own."""
        names = head.expression_names
        expression = torch.tensor([float(self.actions.get(name, 0.0)) for name in names])
        joint = torch.zeros(3)
        if "jawOpen" in names:
            index = names.index("jawOpen")
            expression[index] = max(float(expression[index]), self.jaw)
        else:
            joint[0] = self.jaw * _JAW_RADIANS
        neck = torch.deg2rad(torch.tensor([self.nod, self.turn, self.tilt]))
        eye = torch.deg2rad(torch.tensor([self.gaze_down, self.gaze_left, 0.0]))
        rest = HeadParameters.zeros(head)
        return rest.replace(expression=expression, neck=neck, jaw=joint, eyes=torch.cat((eye, eye)))


def action_groups(head: HeadModel) -> dict[str, tuple[str, ...]]:
    """The head's actions by part of the face, in the head's order; heads of another kind get one group."""
    found: dict[str, list[str]] = {}
    for name in head.expression_names:
        group = next((title for title, starts in _GROUPS.items() if name.startswith(starts)), _OTHERS)
        found.setdefault(group, []).append(name)
    if set(found) == {_OTHERS}:
        return {"Expression": tuple(found[_OTHERS])}
    return {title: tuple(found[title]) for title in (*_GROUPS, _OTHERS) if title in found}
