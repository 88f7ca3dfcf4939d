"""The square around a tracked head that `uika reconstruct` would cut out of the same frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from uika.data import Sample
from uika.head import HeadModel, pose_vertices, project, rodrigues
from uika.photo.preparation import CROP_TO_HEAD, HAIR_LIMIT, HEAD_TO_FACE

FRAMED = 0.75  # share of the padded frame's side from which on a head's square counts as the frame itself
_PARTS = ("face", "scalp", "ears")
_PERSON = 0.5  # mask

Square = tuple[int, int, int]  # x0, y0, side in pixels; may reach outside the frame


def head_square(sample: Sample, head: HeadModel) -> Square | None:
    """Square of 1.5 times the box of head and hair, or None where the frame is such a crop already.

    Frames that a head fills were cropped before (synthetic people, portrait videos prepared at 512 pixels), and are
    taken whole; so are frames without head parameters, or with those of another head model.
    """
    head = head.without_bust
    parameters = sample.parameters
    if parameters is None or len(parameters.identity) != len(head.identity_basis):
        return None
    if len(parameters.expression) != len(head.expression_basis):
        return None
    offset = sample.static_offset
    if offset is not None and len(offset) != len(head.template):
        return None
    vertices = pose_vertices(head, parameters, offset)
    places, _ = project(vertices, sample.camera)
    shown = [head.masks[name] > 0.5 for name in _PARTS if name in head.masks]
    box = places[torch.stack(shown).any(0)] if shown else places
    if not bool(torch.isfinite(box).all()):
        return None
    points = torch.cat((box, _hair(sample, head, places, box)))
    low, high = points.amin(0), points.amax(0)
    side = math.ceil(CROP_TO_HEAD * float((high - low).max()))
    if side >= FRAMED * max(sample.mask.shape):
        return None
    x0, y0 = (round(value) for value in ((low + high - side) / 2).tolist())
    return x0, y0, side


def _hair(sample: Sample, head: HeadModel, places: Tensor, box: Tensor) -> Tensor:
    """Pixels [P,2] of the person beside and above the mouth, up to a face's size beyond the head."""
    parameters = sample.parameters
    assert parameters is not None  # head_square
    turn = sample.camera.viewmat[:3, :3] @ rodrigues(parameters.rotation) @ rodrigues(parameters.neck)
    up = turn[:2, 1]
    up = up / up.norm() if float(up.norm()) > 0.1 else up.new_tensor([0.0, -1.0])
    across = torch.stack((-up[1], up[0]))
    lips = head.masks.get("lips")
    middle = box.mean(0) if lips is None else places[lips > 0.5].mean(0)
    along, sideways = (box - middle) @ up, (box - middle) @ across
    reach = HAIR_LIMIT * float(along.max() - along.min()) / HEAD_TO_FACE
    rows, columns = (sample.mask > _PERSON).nonzero(as_tuple=True)
    pixels = torch.stack((columns, rows), -1) + 0.5
    height, aside = (pixels - middle) @ up, (pixels - middle) @ across
    kept = (height > 0) & (height < along.max() + reach)
    kept &= (aside > sideways.min() - reach) & (aside < sideways.max() + reach)
    return pixels[kept]
