"""What the photos show of hair: its colour, told from that of skin, and its grain, for the hair that no photo shows."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from uika.head import Binding, HeadModel

DEFAULT = 0.5  # grey level where nothing of a kind was seen
SEEN = 0.5  # share of the observation from which a texel tells a colour
LEAST = 60  # texels that tell one
APART = 0.1  # sRGB distance between hair and skin below which all of the scalp is one kind: a bald head, or fair hair
ALIKE = 0.1  # sRGB distance up to which a colour is like another
LEAST_SHARE = 0.1  # of the seen scalp that must be hair; less is a shadow on a bald head
BINS = 64
TEMPLES, CROWN, LOW_TRUST = 0.03, 0.09, 0.2  # metres between which hair gains trust: low, ears and neck are about
AROUND, ENOUGH = 0.03, 4.0  # metres over which seen hair tells of its surroundings; vertices that outweigh the typical
WHORL = (0.0, 0.82, -0.57)  # direction from the skull's middle to where hair grows from
MIDDLE = (0.0, 0.03, -0.045)  # metres, of the skull
STRANDS = (0.012, 0.006, 0.003)  # metres, widths of locks and strands
LONG = 7.0  # length over width of a strand
WAVE = 0.06  # of the way from the whorl, by which locks leave their meridian: more would fold them over
MOST_GRAIN, OUTLIERS = 0.12, 2.5  # sRGB, standard deviation of grain; median deviations that one may count


def kinds(
    head: HeadModel, binding: Binding, points: Tensor, color: Tensor, seen: Tensor, hair: Tensor
) -> tuple[Tensor, Tensor]:
    """Typical colours [3] of skin and of hair; on a bald head the second is that of its scalp.

    Where hair should be, photos show forehead, ears and neck too, if the fit is a little off or the hair is thin: the
    colours there are parted in two by their distance from the skin's.

    Args:
        head: the head model.
        binding: the M texels of the atlas.
        points: [M,3] of the mean head, metres.
        color: [M,3] observed colours.
        seen: [M] share of each texel that was observed, in [0,1], 0 on parts that are neither.
        hair: [M] how far each texel belongs to hair, in [0,1].
    """
    area = texel_areas(head, binding) * (seen > SEEN)
    bare = torch.ones_like(hair)
    for name in ("face", "eyes", "lips"):
        if name in head.masks:
            share = (head.masks[name][head.faces[binding.triangle]] * binding.barycentric).sum(1)
            bare = bare * (share if name == "face" else 1 - share)
    skin = weighted_median(color, area * (bare > 0.5) * (hair < 0.1))
    height = (points[:, 1] - TEMPLES) / (CROWN - TEMPLES)
    weight = area * (hair > 0.5) * height.clamp(LOW_TRUST, 1)
    if int((weight > 0).sum()) < LEAST:
        return skin, torch.full((3,), DEFAULT)
    distance = (color - skin).norm(dim=-1)
    bound = _parting(distance, weight)
    far, near = weight * (distance > bound), weight * (distance <= bound)
    apart = (distance * far).sum() / far.sum().clamp_min(1e-9) - (distance * near).sum() / near.sum().clamp_min(1e-9)
    if bool(apart < APART) or bool(far.sum() < LEAST_SHARE * weight.sum()):
        far = weight
    return skin, weighted_median(color, far)


def like_first(color: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """How far colours [M,3] are like the first [3] and unlike the second [3], in [0,1]; 0 where those two agree."""
    one, other = (color - first).norm(dim=-1), (color - second).norm(dim=-1)
    share = other / (one + other).clamp_min(1e-6)
    alike = ((share - 0.5) / 0.2).clamp(0, 1) * ((first - second).norm() / APART).clamp(0, 1)
    return alike * (2 - one / ALIKE).clamp(0, 1)


def nearby(points: Tensor, color: Tensor, seen: Tensor, typical: Tensor) -> Tensor:
    """Colours [V,3] seen around vertices [V,3] on either side of the head, the typical one [3] far from all of them.

    A veil or a hat's brim goes on beside what was seen of it, whatever the hair is like.

    Args:
        points: of the mean head, metres.
        color: [V,3] observed.
        seen: [V] how well, in [0,1].
        typical: of hair.
    """
    shown = seen > SEEN
    mirror = points.new_tensor([-1.0, 1.0, 1.0])
    apart = [torch.cdist(points, side * points[shown]) for side in (torch.ones_like(mirror), mirror)]
    weight = torch.stack([torch.exp(-0.5 * (each / AROUND).square()) for each in apart]).sum(0) * seen[shown]
    total = weight.sum(1, keepdim=True)
    return (weight @ color[shown] + ENOUGH * typical) / (total + ENOUGH)


def texel_areas(head: HeadModel, binding: Binding) -> Tensor:
    """Square metres [M] of the mean head that each texel stands for."""
    a, b, c = head.template[head.faces].unbind(1)
    area = 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1)
    count = torch.bincount(binding.triangle, minlength=len(head.faces)).clamp_min(1)
    return (area / count)[binding.triangle]


def weighted_median(color: Tensor, weight: Tensor, default: Tensor | None = None) -> Tensor:
    """Median [3] of colours [M,3] by weights [M]; the default [3] or grey where fewer than LEAST have any."""
    chosen = weight > 0
    if int(chosen.sum()) < LEAST:
        return torch.full((3,), DEFAULT) if default is None else default
    values, order = color[chosen].sort(0)
    total = weight[chosen][order].cumsum(0)
    at = (total < total[-1:] / 2).sum(0).clamp_max(len(values) - 1)
    return values.gather(0, at[None])[0]


def _parting(value: Tensor, weight: Tensor) -> Tensor:
    """The value that parts values [M] in the two classes that vary least in themselves (Otsu 1979)."""
    high = float(value[weight > 0].max())
    place = (value / max(high, 1e-9) * BINS).long().clamp(0, BINS - 1)
    mass = torch.zeros(BINS).index_add(0, place, weight)
    moment = torch.zeros(BINS).index_add(0, place, weight * value)
    below, total = mass.cumsum(0), mass.sum()
    first, whole = moment.cumsum(0), moment.sum()
    between = (whole * below - total * first) ** 2 / (below * (total - below)).clamp_min(1e-20)
    return (between.argmax() + 1) * high / BINS


def grain(points: Tensor, detail: Tensor, seen: Tensor) -> Tensor:
    """Deviations [M,3] from smooth hair colours that look like those seen: strands that run down from the whorl.

    Args:
        points: [M,3] texels on the head, metres, Y up.
        detail: [M,3] deviations of observed colours from their smooth continuation.
        seen: [M] bool, where those show hair.

    Returns:
        Of the colour and spread of those seen, the same for the same points; 0 where too little hair was seen.
    """
    if int(seen.sum()) < LEAST:
        return torch.zeros_like(points)
    shown = detail[seen] - detail[seen].median(0).values
    length = shown.norm(dim=-1, keepdim=True)
    shown = shown * (OUTLIERS * length.median() / length.clamp_min(1e-6)).clamp_max(1)
    spread, axes = torch.linalg.eigh(shown.mT @ shown / len(shown))
    # Strands differ in brightness; what else differs is mostly the photo's noise and what shows between them.
    return strands(points)[:, None] * (spread[-1].clamp_min(0).sqrt().clamp_max(MOST_GRAIN) * axes[:, -1])


def strands(points: Tensor) -> Tensor:
    """Noise [M] of variance 1 at points [M,3] in metres, drawn out along the meridians from the whorl."""
    axis = normalize(torch.tensor(WHORL), dim=0)
    first = normalize(torch.linalg.cross(torch.tensor([1.0, 0.0, 0.0]), axis), dim=0)
    second = torch.linalg.cross(axis, first)
    offset = points - torch.tensor(MIDDLE)
    radius = offset.norm(dim=-1)
    polar = torch.arccos((offset @ axis / radius.clamp_min(1e-6)).clamp(-1, 1))
    azimuth = torch.atan2(offset @ second, offset @ first)
    around = 2 * math.pi * 0.1
    azimuth = azimuth + WAVE * polar * _lattice(azimuth, polar, 7, 0.5, len(STRANDS))
    total, square = torch.zeros_like(polar), 0.0
    for octave, width in enumerate(STRANDS):
        # Meridians draw together at the whorl: there the wider locks do.
        fine = (radius * polar.sin() / 0.1).clamp(0, 1)
        value = _lattice(azimuth, polar, round(around / width), LONG * width / 0.1, octave)
        total, square = total + (0.3 + 0.7 * fine) * value, square + 1.0
    return total / square**0.5


def _lattice(azimuth: Tensor, polar: Tensor, count: int, length: float, seed: int) -> Tensor:
    """Interpolated random values [M] of variance about 1 on `count` meridians and rows `length` radians apart."""
    rows = math.ceil(math.pi / length) + 2
    table = torch.randn(rows, count, generator=torch.Generator().manual_seed(seed))
    across = (azimuth / (2 * math.pi) % 1) * count
    along = polar / length
    column, row = across.floor(), along.floor()
    x, y = across - column, along - row
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    c, r = column.long() % count, row.long().clamp(0, rows - 2)
    n = (c + 1) % count
    top = torch.lerp(table[r, c], table[r, n], x)
    bottom = torch.lerp(table[r + 1, c], table[r + 1, n], x)
    # Interpolation averages: the variance of a value between four is 0.55 in the mean.
    return torch.lerp(top, bottom, y) / 0.743
