"""What lips hide: two rows of teeth, gums, tongue and a throat that gets darker, for when no photo shows it."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import HeadModel
from uika.head.mesh_parts import upper_teeth

# sRGB in even light at the front of the mouth.
TEETH, GUMS, TONGUE, CHEEKS = (0.84, 0.81, 0.75), (0.64, 0.37, 0.36), (0.56, 0.30, 0.29), (0.42, 0.20, 0.19)
GAP, GAP_WIDTH = 0.72, 0.16  # level between two teeth over that of a tooth; of a tooth's width
TOOTH = 0.0075  # metres, mean width
GUM = 0.22  # share of a row's height that lies under the gums
_ROW_CENTRE = 0.025  # metres behind the front teeth around which a row bends
_FAR = 0.035  # metres behind the front teeth where it is dark
_DARK = 0.12  # level there over that at the lips


def hidden_mouth(head: HeadModel, points: Tensor, inner: Tensor, tongue: Tensor, teeth: Tensor) -> Tensor:
    """Colours [M,3] in even light for texels of the mouth's inside.

    Args:
        head: the head model.
        points: [M,3] texels on its template, metres.
        inner: [M] True inside the mouth, teeth included; other texels get no meaningful colour.
        tongue: [M] True on the tongue.
        teeth: [M] True on the teeth.
    """
    colors = torch.where(tongue[:, None], torch.tensor(TONGUE), torch.tensor(CHEEKS))
    front = points[teeth if bool(teeth.any()) else inner, 2].max()
    if bool(teeth.any()):
        colors[teeth] = _rows(head, points[teeth], float(front))
    near = (1 - (front - points[:, 2:]) / _FAR).clamp(0, 1)
    return colors * (_DARK + (1 - _DARK) * near * near * (3 - 2 * near))


def _rows(head: HeadModel, points: Tensor, front: float) -> Tensor:
    """Colours [P,3] of the teeth with their gums and gaps."""
    own = (head.masks["teeth"] > 0.5).nonzero()[:, 0]
    upper = upper_teeth(head)[own][torch.cdist(points, head.template[own]).argmin(1)]
    result = torch.empty_like(points)
    for row, up in ((upper, 1.0), (~upper, -1.0)):
        if not bool(row.any()):
            continue
        place = points[row]
        low, high = place[:, 1].min(), place[:, 1].max()
        rooted = ((place[:, 1] - low) if up > 0 else (high - place[:, 1])) / (high - low).clamp_min(1e-6)
        gum = ((rooted - (1 - GUM)) / (0.5 * GUM)).clamp(0, 1)[:, None]
        along = _ROW_CENTRE * torch.atan2(place[:, 0], place[:, 2] - (front - _ROW_CENTRE)) / TOOTH
        # The middle of the face lies between two teeth.
        beside = (along - along.round()).abs()
        gap = GAP + (1 - GAP) * (beside / GAP_WIDTH).clamp(0, 1)[:, None]
        result[row] = torch.lerp(gap * torch.tensor(TEETH), torch.tensor(GUMS), gum)
    return result
