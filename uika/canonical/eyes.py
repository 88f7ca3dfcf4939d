"""Whole eyes from what the lids left free: an iris is round, and what lies around it is white."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.canonical.tint import Tone
from uika.head import HeadModel

IRIS_RADIUS = 0.0059  # metres; hardly differs between people
PUPIL_RADIUS = 0.0019
IRIS = (0.36, 0.25, 0.18)  # sRGB in even light, where no iris was seen
PUPIL = (0.05, 0.04, 0.04)
LIMBUS = 0.6  # darkness of the iris' rim
SCLERA = (0.80, 0.77, 0.75)
_EYES = (3, 4)  # joints
_SEARCH, _STEP = 0.002, 0.00025  # metres that the iris may lie beside its place, for the gaze that the fit missed
_RIM = 0.0012  # metres to both sides of the iris' edge that are compared
_WIDTH = 0.0005  # metres, of the rings of which each has one colour
_MIN_TEXELS = 12
_PALE = 0.6  # quantile of the seen white's level that stands for all of it: the rest lies in the lids' shadow
_MAX_CHROMA = 0.12  # of the white over its level
_LEAST = 0.75  # of the expected white's level


def complete_eyes(
    head: HeadModel, points: Tensor, label: Tensor, color: Tensor, known: Tensor, brightness: float, tone: Tone
) -> Tensor:
    """Colours for the eyeballs' texels, as whole eyes.

    Args:
        head: the head model.
        points: [M,3] texels on its template, metres.
        label: [M] True on the eyeballs.
        color: [M,3] observed colours.
        known: [M] share of each texel that was observed well, in [0,1].
        brightness: light in the photos, a factor on colours that nothing was seen of.
        tone: of the photos, for those colours.

    Returns:
        [M,3], `color` outside the eyeballs.
    """
    result = color.clone()
    places = [_eye(head, points, label, joint) for joint in _EYES]
    seen = torch.cat([own for own, _ in places])
    white = _white(
        color[seen],
        known[seen],
        torch.cat([place.norm(dim=-1) for _, place in places]),
        tone.apply(brightness * torch.tensor(SCLERA)),
    )
    for own, place in places:
        middle = _middle(place, color[own].mean(-1), known[own])
        radius = (place - middle).norm(dim=-1)
        iris = _rings(radius, color[own], known[own], tone.apply(brightness * _common_iris(radius)))
        inside = ((IRIS_RADIUS + 0.5 * _WIDTH - radius) / _WIDTH).clamp(0, 1)[:, None]
        result[own] = torch.lerp(white, iris, inside)
    return result


def _eye(head: HeadModel, points: Tensor, label: Tensor, joint: int) -> tuple[Tensor, Tensor]:
    """Texels [P] of one eyeball, and their place [P,2] around its axis: metres along the ball, right and up."""
    centre = head.joints[joint]
    own = (label & (points[:, 0] * centre[0] > 0)).nonzero()[:, 0]
    offset = points[own] - centre
    flat = offset[:, :2].norm(dim=-1, keepdim=True)
    arc = offset.norm(dim=-1, keepdim=True) * torch.atan2(flat, offset[:, 2:])
    return own, offset[:, :2] / flat.clamp_min(1e-9) * arc


def _middle(place: Tensor, level: Tensor, known: Tensor) -> Tensor:
    """Where the iris lies [2]: the ring inside its edge is darker than the one outside."""
    steps = torch.arange(-_SEARCH, _SEARCH + _STEP / 2, _STEP)
    offsets = torch.cartesian_prod(steps, steps)
    radius = (place - offsets[:, None]).norm(dim=-1) - IRIS_RADIUS
    inner, outer = ((known * ((radius * sign > 0) & (radius.abs() < _RIM))) for sign in (-1, 1))
    rims = [(rim * level).sum(1) / rim.sum(1).clamp_min(1e-6) for rim in (inner, outer)]
    enough = (inner.sum(1) > _MIN_TEXELS) & (outer.sum(1) > _MIN_TEXELS)
    if not bool(enough.all()):
        return torch.zeros(2)
    # Far places need a clear edge: half of the contrast that the nearest one has.
    contrast = rims[1] - rims[0]
    contrast = contrast - 0.5 * contrast.max().clamp_min(0) * (offsets.norm(dim=-1) / _SEARCH) ** 2
    return offsets[int(contrast.argmax())]


def _common_iris(radius: Tensor) -> Tensor:
    """Colours [P,3] in even light of an iris and its pupil."""
    color = torch.where(radius[:, None] < PUPIL_RADIUS, torch.tensor(PUPIL), torch.tensor(IRIS))
    rim = ((radius - 0.8 * IRIS_RADIUS) / (0.2 * IRIS_RADIUS)).clamp(0, 1)[:, None]
    return color * (1 - (1 - LIMBUS) * rim)


def _rings(radius: Tensor, color: Tensor, known: Tensor, common: Tensor) -> Tensor:
    """Colours [P,3] of an iris and its pupil by radius alone: those of the seen rings, else the common ones [P,3]."""
    ring = (radius / _WIDTH).long()
    inside = (radius < IRIS_RADIUS) & (known > 0.5)
    if int(inside.sum()) < _MIN_TEXELS:
        return common
    seen = [ring[inside] == index for index in range(int(IRIS_RADIUS / _WIDTH) + 1)]
    filled = [index for index, chosen in enumerate(seen) if int(chosen.sum()) >= 3]
    if not filled:
        return common
    table = torch.stack([color[inside][seen[index]].median(0).values for index in filled])
    nearest = (ring[:, None] - torch.tensor(filled)).abs().argmin(1)
    return table[nearest]


def _white(color: Tensor, known: Tensor, radius: Tensor, expected: Tensor) -> Tensor:
    """The white of the eyes [3], near the expected tone and not in shadow."""
    chosen = color[(known > 0.5) & (radius > IRIS_RADIUS + _RIM)]
    if len(chosen) < _MIN_TEXELS:
        return expected
    level = chosen.mean(-1)
    bright = chosen[level >= level.quantile(_PALE)].mean(0)
    level = bright.mean().clamp(_LEAST * float(expected.mean()), 1.0)
    usual = expected / expected.mean().clamp_min(1e-3)
    return (level * (usual + (bright / bright.mean().clamp_min(1e-3) - usual).clamp(-_MAX_CHROMA, _MAX_CHROMA))).clamp(
        0, 1
    )
