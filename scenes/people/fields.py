"""Where things are on the head's atlas: places in space and signed distances to the features of the face."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import torch
from torch import Tensor

from uika.head import Binding, HeadModel, surface_points, uv_texels

# MediaPipe face-mesh contours, in order around each feature.
_LIPS_OUTER = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
_LIPS_INNER = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
_EYES = (
    (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466),
    (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246),
)
_BROWS_UPPER = ((336, 296, 334, 293, 300), (107, 66, 105, 63, 70))  # from the nose outwards
_BROWS_LOWER = ((285, 295, 282, 283, 276), (55, 65, 52, 53, 46))
_IRIS_RADIUS = 0.0059  # metres, of an adult
_JOINTS = (3, 4)


@dataclass(frozen=True, eq=False)
class Fields:
    """M texels of one head model's atlas; distances are in metres on the template."""

    binding: Binding
    points: Tensor  # [M,3] on the template
    normals: Tensor  # [M,3]
    masks: dict[str, Tensor]  # name -> [M] in [0,1]
    lips: Tensor  # [M] signed distance to the lips' outline, negative inside
    mouth: Tensor  # [M] distance to the line between the lips
    lids: Tensor  # [M] distance to the edges of the eyelids
    brow_along: Tensor  # [M] 0 at the brow's inner end, 1 at its outer end
    brow_across: Tensor  # [M] signed distance above the brow's centre line
    iris: Tensor  # [M] angle from the axis of the eye over the iris' own; large away from the eyeballs
    iris_turn: Tensor  # [M] angle around that axis, radians

    def select(self, index: Tensor) -> Fields:
        """The fields at some of the texels; the binding stays that of all."""
        masks = {name: mask[index] for name, mask in self.masks.items()}
        tensors = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in ("binding", "masks")}
        return Fields(binding=self.binding, masks=masks, **tensors)


@lru_cache(maxsize=2)
def atlas_fields(head: HeadModel, size: int) -> Fields:
    """Fields of a head with face-mesh landmarks; computed once for each head and atlas size.

    Raises:
        ValueError: the head lacks the landmarks or masks of a face.
    """
    needed = {"eyeballs", "mouth_inner", "scalp", "face"} - set(head.masks)
    known = set(head.landmark_ids.tolist())
    if needed or len(known) < 400:
        raise ValueError(f"the head model '{head.id}' lacks face-mesh landmarks or masks, which painting needs")
    binding = uv_texels(head, size)
    points = surface_points(head.template, head.faces, binding)
    corners = head.faces[binding.triangle]
    normals = torch.nn.functional.normalize(_normals(head)[corners].mul(binding.barycentric[..., None]).sum(1), dim=-1)
    masks = {name: (mask[corners] * binding.barycentric).sum(-1) for name, mask in head.masks.items()}
    marks = head.landmarks(head.template)
    place = {int(i): marks[k] for k, i in enumerate(head.landmark_ids)}
    inner, outer = _line(place, _LIPS_INNER), _line(place, _LIPS_OUTER)
    outside_mouth = masks["mouth_inner"] < 0.5
    lips = _signed_distance(points, outer)
    mouth = torch.where(outside_mouth, _distance(points, inner), 0.0)
    lids = torch.stack([_distance(points, _line(place, ring)) for ring in _EYES]).amin(0)
    along, across = _brows(points, place)
    iris, turn = _irises(head, points, masks["eyeballs"])
    return Fields(binding, points, normals, masks, lips, mouth, lids, along, across, iris, turn)


def _normals(head: HeadModel) -> Tensor:
    from uika.head import vertex_normals

    return vertex_normals(head.template, head.faces)


def _line(place: dict[int, Tensor], ids: tuple[int, ...]) -> Tensor:
    """Points [R,3] of a contour; a point that the head lacks is left out."""
    return torch.stack([place[i] for i in ids if i in place])


def _distance(points: Tensor, ring: Tensor) -> Tensor:
    """Distance [M] of points [M,3] to a closed line [R,3]; 1 for points more than 6 cm from its centre."""
    result = torch.ones(len(points))
    near = ((points - ring.mean(0)).norm(dim=-1) < 0.06).nonzero()[:, 0]
    start, run = ring, ring.roll(-1, 0) - ring
    offset = points[near, None] - start
    share = ((offset * run).sum(-1) / (run * run).sum(-1).clamp_min(1e-12)).clamp(0, 1)
    result[near] = (offset - share[..., None] * run).norm(dim=-1).amin(1)
    return result


def _signed_distance(points: Tensor, ring: Tensor) -> Tensor:
    """`_distance`, negative where the point lies inside the ring as seen from the front."""
    distance = _distance(points, ring)
    a, b = ring[:, :2], ring.roll(-1, 0)[:, :2]
    near = (distance < 1).nonzero()[:, 0]
    x, y = points[near, 0:1], points[near, 1:2]
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    at = a[:, 0] + (y - a[:, 1]) * (b - a)[:, 0] / torch.where((b - a)[:, 1].abs() < 1e-9, 1e-9, (b - a)[:, 1])
    inside = (crosses & (x < at)).sum(1) % 2 == 1
    distance[near[inside]] *= -1
    return distance


def _brows(points: Tensor, place: dict[int, Tensor]) -> tuple[Tensor, Tensor]:
    along, across = torch.full((len(points),), -1.0), torch.ones(len(points))
    for upper, lower in zip(_BROWS_UPPER, _BROWS_LOWER, strict=True):
        line = (_line(place, upper) + _line(place, lower)) / 2
        near = (((points - line.mean(0)).norm(dim=-1) < 0.05) & (points[:, 0] * line[2, 0] > 0)).nonzero()[:, 0]
        start, run = line[:-1], line[1:] - line[:-1]
        offset = points[near, None] - start
        share = (offset * run).sum(-1) / (run * run).sum(-1)
        # The ends are open, so that places beyond them fall outside 0..1.
        limit = torch.zeros_like(share)
        clamped = torch.maximum(torch.minimum(share, limit + 1), limit)
        first, last = share[:, 0], share[:, -1]
        miss = offset - clamped[..., None] * run
        best = miss.norm(dim=-1).argmin(1)
        row = torch.arange(len(near))
        position = (best + clamped[row, best]) / len(run)
        position = torch.where((best == 0) & (first < 0), first / len(run), position)
        position = torch.where((best == len(run) - 1) & (last > 1), 1 + (last - 1) / len(run), position)
        along[near] = position
        across[near] = miss[row, best].norm(dim=-1) * torch.sign(miss[row, best][:, 1])
    return along, across


def _irises(head: HeadModel, points: Tensor, eyeballs: Tensor) -> tuple[Tensor, Tensor]:
    iris, turn = torch.full((len(points),), 10.0), torch.zeros(len(points))
    for joint in _JOINTS:
        centre = head.joints[joint]
        own = ((eyeballs > 0.5) & (points[:, 0] * centre[0] > 0)).nonzero()[:, 0]
        offset = points[own] - centre
        radius = float(offset.norm(dim=-1).median())
        iris[own] = torch.atan2(offset[:, :2].norm(dim=-1), offset[:, 2]) / (_IRIS_RADIUS / radius)
        turn[own] = torch.atan2(offset[:, 1], offset[:, 0])
    return iris, turn
