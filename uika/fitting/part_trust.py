"""Trust in pixels where lids and lips open and shut: a fit that is a pixel off mixes parts there."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from uika.head import HeadModel, HeadParameters, pose_vertices
from uika.photo.outline import polygon

RIGHT_EYE = (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246)
LEFT_EYE = (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466)
INNER_LIPS = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
EYE_CORNERS = (33, 263)
MARGIN = 0.006  # of the eye corners' distance: width of the edge of an eye that shows lashes and shadow
LIP_MARGIN = 0.02  # of that distance, by which lips of the fit and of the landmarks may lie apart
OPEN = 0.05  # height over width from which an opening shows what lies behind it
SMOOTH, FOLDED = 1.15, 1.6  # stretch of a lid from now to shut between which it loses trust
LID_DOUBT, FOLD_DOUBT = 0.3, 0.98  # of a lid that lies open, and of one that is folded away


def lid_doubt(head: HeadModel, params: HeadParameters, static_offset: Tensor) -> Tensor:
    """Doubt [V] in what a photo shows of the lids: those of an open eye are folded away, in the shadow of their crease.

    Args:
        head: the head model; one without masks or actions for the eyes has no doubt.
        params: of one photo.
        static_offset: [V,3] metres.
    """
    names = head.expression_names
    if "eyes" not in head.masks or "eyeBlinkLeft" not in names:
        return torch.zeros(len(head.template))
    shut = params.expression.clone()
    for side in ("Left", "Right"):
        shut[names.index("eyeBlink" + side)] = 1.0
        for other in ("eyeWide", "eyeSquint"):
            if other + side in names:
                shut[names.index(other + side)] = 0.0
    now, then = (_areas(head, pose_vertices(head, p, static_offset)) for p in (params, params.replace(expression=shut)))
    stretch = (then / now.clamp_min(1e-12)).sqrt()
    folded = ((stretch - SMOOTH) / (FOLDED - SMOOTH)).clamp(0, 1)
    return head.masks["eyes"] * torch.lerp(torch.tensor(LID_DOUBT), torch.tensor(FOLD_DOUBT), folded)


def _areas(head: HeadModel, vertices: Tensor) -> Tensor:
    """Area [V] of the triangles around each vertex."""
    a, b, c = (vertices[head.faces[:, corner]] for corner in range(3))
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    return torch.zeros(len(vertices)).index_add(0, head.faces.flatten(), area.repeat_interleave(3))


def opening_trust(landmarks: Tensor, size: int, eyeball: Tensor, mouth: Tensor) -> Tensor:
    """Trust [S,S] in pixels at the openings of eyes and mouth: the fit and the landmarks must name the same part.

    Args:
        landmarks: [478,2] pixels.
        size: S.
        eyeball: [S,S] share of a pixel that the fit gives to an eyeball.
        mouth: [S,S] share that it gives to teeth or the mouth's inside.
    """
    marks = landmarks.double().numpy()
    distance = float(np.linalg.norm(marks[EYE_CORNERS[0]] - marks[EYE_CORNERS[1]]))
    reach, slack = (max(1, round(margin * distance)) for margin in (MARGIN, LIP_MARGIN))
    eyes = _opening(marks, RIGHT_EYE, size) | _opening(marks, LEFT_EYE, size)
    trust = torch.ones(size, size)
    trust[(eyeball > 0.5) & ~_shrunk(eyes, reach)] = 0.0
    trust[(eyeball < 0.5) & _shrunk(eyes, 2 * reach)] = 0.0
    lips = _opening(marks, INNER_LIPS, size)
    trust[(mouth > 0.5) & ~_grown(lips, slack)] = 0.0
    trust[(mouth < 0.5) & _shrunk(lips, slack)] = 0.0
    return trust


def _opening(marks: np.ndarray, outline: tuple[int, ...], size: int) -> Tensor:
    """Pixels [S,S] inside an outline of landmarks; none where it is all but shut."""
    points = marks[list(outline)]
    _, spread, _ = np.linalg.svd(points - points.mean(0), full_matrices=False)
    if spread[1] < OPEN * spread[0]:
        return torch.zeros(size, size, dtype=torch.bool)
    return torch.from_numpy(polygon(points, size))


def _grown(mask: Tensor, reach: int) -> Tensor:
    return max_pool2d(mask.float()[None, None], 2 * reach + 1, 1, reach)[0, 0] > 0


def _shrunk(mask: Tensor, reach: int) -> Tensor:
    return ~_grown(~mask, reach)
