"""Points of the head's surface that a correspondence estimator finds in photos, for the fit."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from uika.fitting import SurfaceMarks
from uika.head import HeadModel, uv_texels

if TYPE_CHECKING:
    from uika.model.surface_estimator import SurfaceEstimator

POINTS = 200
SIDE = 256  # pixels of the pictures in which they are looked for
_ATLAS = 192  # texels in which the points are chosen
_BORDER = 6  # texels from a seam, beyond which one side of a point's surroundings cannot be found
# The neck turns with joints that a fit to photos leaves at rest.
_LEFT_OUT = ("eyeballs", "mouth_inner", "teeth", "neck")
_BLIND = 0.012  # metres from the nearest landmark on the mean head, beyond which landmarks know little
_NEAR = 0.02  # of the atlas: pixels farther from a point's place do not tell where it is
_PIXELS = 16  # nearest ones that tell
_LEAST = 6.0  # sum of their weights from which the point counts as seen
_PERSON = 0.7  # matte
_TRUSTED = 0.08  # confidence, which the built-in estimator keeps low
_SPREAD_PIXELS = 6.0  # pixels of SIDE: a point whose surroundings lie farther apart is torn between two places


@torch.no_grad()
def surface_marks(estimator: SurfaceEstimator, head: HeadModel, images: Tensor, mattes: Tensor) -> SurfaceMarks:
    """Where the skin of N photos shows chosen points of the surface.

    Hair is left out: it stands off the bald head that is fitted first.

    Args:
        estimator: trained for this head model.
        head: the head model.
        images: [N,3,S,S] in [0,1] on one plain colour.
        mattes: [N,S,S] in [0,1].
    """
    head = head.without_bust
    triangle, barycentric, uv = surface_points(head, POINTS)
    size = images.shape[-1]
    small = functional.interpolate(images, size=(SIDE, SIDE), mode="bilinear", antialias=True)
    person = functional.interpolate(mattes[:, None], size=(SIDE, SIDE), mode="area")[:, 0] > _PERSON
    seen = estimator.observe(small[None])
    places, weights = [], []
    for n in range(len(images)):
        trust = seen.confidence[0, n] * (1 - seen.hair[0, n]) * person[n]
        place, weight = find_points(uv, seen.uv[0, n], trust)
        places.append(place * (size / SIDE))
        weights.append(weight)
    return SurfaceMarks(triangle, barycentric, torch.stack(places), torch.stack(weights))


def find_points(points: Tensor, uv: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [D,2] (centres at +0.5) that show atlas places [D,2], by a plane through their surroundings.

    Args:
        points: [D,2] places, v down.
        uv: [2,H,W] what the pixels show.
        trust: [H,W] in [0,1]; pixels of next to none are left out.

    Returns:
        The pixels, and the trust [D] in each, 0 where it is not seen.
    """
    rows, columns = (trust > _TRUSTED).nonzero(as_tuple=True)
    if len(rows) < _PIXELS:
        return torch.zeros(len(points), 2), torch.zeros(len(points))
    pixels = torch.stack((columns, rows), -1) + 0.5
    there = uv[:, rows, columns].mT.contiguous()
    distance, nearest = torch.cdist(points, there).topk(_PIXELS, largest=False)
    weight = (1 - distance / _NEAR).clamp_min(0)
    total = weight.sum(1)
    at, step = pixels[nearest], (there[nearest] - points[:, None]) / _NEAR
    mean = (at * weight[..., None]).sum(1) / total.clamp_min(1e-6)[:, None]
    spread = ((at - mean[:, None]).norm(dim=-1) * weight).sum(1) / total.clamp_min(1e-6)
    # Where a plane through the pixels' places has the point's own.
    rows3 = torch.cat((torch.ones_like(step[..., :1]), step), -1).double() * weight[..., None].double().sqrt()
    right = at.double() * weight[..., None].double().sqrt()
    matrix = rows3.mT @ rows3 + torch.diag(torch.tensor([1e-9, 1e-2, 1e-2], dtype=torch.float64))
    place = torch.linalg.solve(matrix, rows3.mT @ right)[:, 0].float()
    good = (total > _LEAST) & (spread < _SPREAD_PIXELS) & ((place - mean).norm(dim=-1) < _SPREAD_PIXELS)
    sure = (trust[rows, columns][nearest] * weight).sum(1) / total.clamp_min(1e-6)
    return torch.where(good[:, None], place, mean), sure * good


@lru_cache(maxsize=4)
def surface_points(head: HeadModel, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles [D], barycentrics [D,3] and atlas places [D,2] of points spread evenly where landmarks are blind."""
    binding = uv_texels(head, _ATLAS)
    inner = -functional.max_pool2d(-binding.valid[None, None].float(), 2 * _BORDER + 1, 1, _BORDER)[0, 0]
    corners = head.faces[binding.triangle]
    points = (head.template[corners] * binding.barycentric[..., None]).sum(1)
    usable = inner.flatten()[binding.texel] > 0
    usable &= torch.cdist(points, head.landmarks(head.template)).amin(1) > _BLIND
    for name in _LEFT_OUT:
        if name in head.masks:
            usable &= head.masks[name][corners].amax(-1) < 0.5
    chosen = usable.nonzero()[:, 0]
    points = points[chosen]
    taken = [int(points[:, 2].argmax())]
    away = (points - points[taken[0]]).norm(dim=-1)
    for _ in range(min(count, len(chosen)) - 1):
        taken.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[taken[-1]]).norm(dim=-1))
    rows = chosen[torch.tensor(taken)]
    return binding.triangle[rows], binding.barycentric[rows], binding.uv[rows]
