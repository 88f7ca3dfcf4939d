"""The tone of a photo, which what is supposed has to share: no red mouth in black and white."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_GREY, _COLOURED = 0.006, 0.02  # remaining chroma between which a photo turns from one tone to many
_SKIN = (0.78, 0.60, 0.52)  # sRGB of skin in even light; its hue differs little between people, its level much
_CAST_SHARE, _MAX_CAST = 0.5, 1.25  # how far the skin's hue tells the light's, and where it stops
_DEGREE = 2
_LEAST = 300  # texels that tell a tone


class Tone(NamedTuple):
    """How the colours of photos lie: chroma (colour minus level) as a polynomial of level, if that is all there is."""

    coefficients: Tensor  # [D,3]
    single: float  # share in [0,1] of the single tone
    saturation: float  # of the photos' chroma over the usual one, in [0,1]
    cast: Tensor  # [3] factors of the light's colour

    def apply(self, colors: Tensor) -> Tensor:
        """Colours [...,3] in even light in the tone of the photos."""
        level = colors.mean(-1, keepdim=True)
        colors = colors * self.cast
        free = self.saturation * (colors - level)
        return (level + torch.lerp(free, _powers(level) @ self.coefficients, self.single)).clamp(0, 1)


def tone(color: Tensor, known: Tensor, skin: Tensor) -> Tone:
    """The tone of observed colours.

    Args:
        color: [M,3] sRGB in [0,1].
        known: [M] share of each that was observed well.
        skin: [M] True on bare skin.
    """
    even = torch.ones(3)
    seen = known > 0.5
    seen = seen & skin if int((seen & skin).sum()) >= _LEAST else seen
    if int(seen.sum()) < _LEAST:
        return Tone(torch.zeros(_DEGREE, 3), 0.0, 1.0, even)
    level = color[seen].mean(-1, keepdim=True)
    chroma = color[seen] - level
    powers = _powers(level)
    matrix = powers.mT @ powers + 1e-3 * len(level) * torch.eye(_DEGREE)
    coefficients = torch.linalg.solve(matrix, powers.mT @ chroma)
    rest = float((chroma - powers @ coefficients).square().sum(-1).mean().sqrt())
    single = min(max((_COLOURED - rest) / (_COLOURED - _GREY), 0.0), 1.0)
    usual = torch.tensor(_SKIN) / torch.tensor(_SKIN).mean()
    found = (color[seen] / level.clamp_min(0.05)).median(0).values
    saturation = float(((found - 1).norm() / (usual - 1).norm()).clamp(0, 1))
    cast = (found / found.mean() / usual).clamp_min(1e-3) ** _CAST_SHARE
    return Tone(coefficients, single, saturation, torch.lerp(even, cast.clamp(1 / _MAX_CAST, _MAX_CAST), saturation))


def _powers(level: Tensor) -> Tensor:
    return torch.cat([level**power for power in range(1, _DEGREE + 1)], -1)
