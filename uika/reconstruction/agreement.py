"""Whether photos show one person: the drawing of their faces, compared in the atlas."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from uika.errors import UikaWarning
from uika.head import HeadModel, uv_texels
from uika.uv import accumulate, pool

if TYPE_CHECKING:
    from uika.photo import Photo

SIZE = 128  # texels along the atlas
SEEN = 0.15  # trust from which a texel counts
BANDS = ((0, 4), (2, 10))  # standard deviations in texels between which the drawing lies: brows, lids, lips, beard
LEAST = 200  # texels that two photos must share
# Of 19 pairs of photos of one person the least alike reached 0.57, across a turn of 60 degrees, and the next 0.67; of
# 387 pairs of different people seven in ten stay below.
ALIKE = 0.55
_LUMA = (0.299, 0.587, 0.114)


class FaceDrawing(NamedTuple):
    """What a photo shows of a face, band by band: details [2,S,S] and where it is known [S,S]."""

    detail: Tensor
    known: Tensor


@torch.no_grad()
def face_drawings(head: HeadModel, images: Tensor, uv: Tensor, weight: Tensor) -> list[FaceDrawing]:
    """The face in each photo, with slow changes, which light makes, left out.

    Args:
        head: the head model; without masks every photo is unknown.
        images: [N,3,H,W] sRGB in [0,1].
        uv: [N,2,H,W] with v down, NaN where a pixel shows no part of the head.
        weight: [N,H,W] trust in them, in [0,1].
    """
    head = head.without_bust
    face = head.masks.get("face", torch.zeros(len(head.template)))
    for name in ("eyeballs", "mouth_inner"):
        face = face * (1 - head.masks.get(name, torch.zeros_like(face)))
    binding = uv_texels(head, SIZE)
    on_face = binding.to_map((face[head.faces[binding.triangle]] * binding.barycentric).sum(1, keepdim=True))[0] > 0.5
    masks = torch.ones_like(weight)[None, :, None]
    found = []
    for n in range(len(images)):
        one = slice(n, n + 1)
        sums = accumulate(images[None, one], uv[None, one], masks[:, one], SIZE, weights=weight[None, one, None])
        seen = pool(sums)
        known = ((seen.trust[0, 0] > SEEN) & on_face).float()
        grey = torch.einsum("chw,c->hw", seen.rgb[0], seen.rgb.new_tensor(_LUMA))
        detail = torch.stack([_blurred(grey, known, fine) - _blurred(grey, known, coarse) for fine, coarse in BANDS])
        found.append(FaceDrawing(detail * known, known))
    return found


def agreement(one: FaceDrawing, other: FaceDrawing) -> float:
    """Mean correlation of two faces over the bands, in [-1,1]; NaN where they show too little in common."""
    both = (one.known * other.known) > 0
    if int(both.sum()) < LEAST:
        return math.nan
    a, b = (face.detail[:, both] - face.detail[:, both].mean(1, keepdim=True) for face in (one, other))
    return float(((a * b).sum(1) / (a.norm(dim=1) * b.norm(dim=1)).clamp_min(1e-9)).mean())


def best_agreements(faces: Sequence[FaceDrawing]) -> list[float]:
    """For each face its agreement with the one most like it; NaN where none shows enough in common."""
    table = torch.tensor(
        [[math.nan if i == j else agreement(a, b) for j, b in enumerate(faces)] for i, a in enumerate(faces)]
    )
    best = torch.nan_to_num(table, nan=-2.0).amax(1) if len(faces) > 1 else torch.full((len(faces),), -2.0)
    return [math.nan if value < -1.5 else value for value in best.tolist()]


def warn_of_strangers(photos: Sequence[Photo], agreements: Sequence[float]) -> None:
    """Warn (`UikaWarning`) of photos whose face is like that in no other; without `agreements` nothing is known."""
    if not agreements:
        return
    strangers = [photo for photo, value in zip(photos, agreements, strict=True) if value < ALIKE]
    if strangers:
        names = ", ".join(photo.path for photo in strangers)
        worst = min(value for value in agreements if value < ALIKE)
        warnings.warn(
            f"{names}: shows a face unlike that in the other photos (agreement {worst:.2f}, one person's reach "
            f"{ALIKE}); give photos of one person only",
            UikaWarning,
            stacklevel=4,
        )


def _blurred(values: Tensor, known: Tensor, spread: int) -> Tensor:
    """Values [S,S] averaged over known neighbours by a Gaussian of `spread` texels; as they are for 0."""
    if spread == 0:
        return values
    line = torch.exp(-0.5 * (torch.arange(-3 * spread, 3 * spread + 1) / spread).square())
    line = line / line.sum()

    def smooth(plane: Tensor) -> Tensor:
        rows = conv2d(plane[None, None], line[None, None, :, None], padding=(3 * spread, 0))
        return conv2d(rows, line[None, None, None], padding=(0, 3 * spread))[0, 0]

    return smooth(values * known) / smooth(known).clamp_min(1e-4)
