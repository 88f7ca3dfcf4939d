"""Gradients of splats against finite differences of Mitsuba's renders."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scenes.reference_render import render
from scenes.validation.splat_head import splat_head, texture
from uika.head import Camera, HeadModel, HeadParameters, look_at, pose_vertices

NAMES = ("camera yaw", "jaw angle", "expression")
_STEPS = (0.006, 0.012, 0.06)  # radians, radians, activation: a few tenths of a pixel at the image's size
_POINT = (0.0, 0.1, 0.3)
_GOAL = (0.05, 0.2, 0.8)
_SIZE, _SPP = 256, 16
MIN_COSINE, RATIO_RANGE = 0.95, (0.6, 1.6)


@dataclass(frozen=True)
class GradientReport:
    """Derivatives of one image loss by camera yaw, jaw angle and one expression, each in units of its step."""

    splats: tuple[float, ...]
    mitsuba: tuple[float, ...]

    @property
    def cosine(self) -> float:
        """Cosine of the angle between the two gradients."""
        a, b = np.array(self.splats), np.array(self.mitsuba)
        return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-20))

    @property
    def ratios(self) -> tuple[float, ...]:
        """Each splat derivative over Mitsuba's."""
        return tuple(round(a / b, 4) if b else math.nan for a, b in zip(self.splats, self.mitsuba, strict=True))

    def passed(self) -> bool:
        """Whether direction, signs and sizes agree."""
        low, high = RATIO_RANGE
        return self.cosine >= MIN_COSINE and all(low <= ratio <= high for ratio in self.ratios)


def compare_gradients(head: HeadModel) -> GradientReport:
    """Differentiate the mean square difference of two flat-lit images of a head by yaw, jaw and an expression."""
    paint = texture()
    names = list(head.expression_names)
    action = names.index("mouthSmileLeft") if "mouthSmileLeft" in names else 0

    def parameters(values: Tensor) -> HeadParameters:
        zero = HeadParameters.zeros(head)
        jaw = torch.cat((values[1:2], values.new_zeros(2)))
        expression = zero.expression.index_put((torch.tensor([action]),), values[2:3])
        return zero.replace(jaw=jaw, expression=expression)

    def mitsuba_image(values: Tensor) -> np.ndarray:
        vertices = pose_vertices(head, parameters(values))
        return render(vertices, head, _camera(values[0]), paint, ("rgb",), _SPP, "flat", background=(0, 0, 0))["rgb"]

    def splat_image(values: Tensor) -> Tensor:
        image, alpha, _ = splat_head(head, parameters(values), paint, _camera(values[0]))
        return image * alpha[..., None]

    # Each renderer aims at its own image of the goal, so that only their derivatives are compared.
    goal = mitsuba_image(torch.tensor(_GOAL))

    def mitsuba_loss(values: Tensor) -> float:
        return float(np.mean((mitsuba_image(values) - goal) ** 2))

    values = torch.tensor(_POINT, requires_grad=True)
    with torch.no_grad():
        splat_goal = splat_image(torch.tensor(_GOAL))
    loss = ((splat_image(values) - splat_goal) ** 2).mean()
    (gradient,) = torch.autograd.grad(loss, values)
    differences = []
    for index, step in enumerate(_STEPS):
        shift = torch.zeros(3)
        shift[index] = step
        point = values.detach()
        differences.append((mitsuba_loss(point + shift) - mitsuba_loss(point - shift)) / 2)
    scaled = gradient * torch.tensor(_STEPS)
    return GradientReport(tuple(scaled.tolist()), tuple(differences))


def _camera(yaw: Tensor) -> Camera:
    """A camera that swings around the head by `yaw` radians from a fixed view."""
    base = look_at(15, 5, 0.85, (0.0, -0.02, -0.01), size=_SIZE)
    cos, sin, zero, one = torch.cos(yaw), torch.sin(yaw), torch.zeros(()), torch.ones(())
    turn = torch.stack(
        (
            torch.stack((cos, zero, -sin, zero)),
            torch.stack((zero, one, zero, zero)),
            torch.stack((sin, zero, cos, zero)),
            torch.stack((zero, zero, zero, one)),
        )
    )
    return Camera(base.viewmat @ turn, base.K, base.width, base.height)
