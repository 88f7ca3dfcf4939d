"""Items as photos of people in use: crops, backgrounds, mattes with errors, shoulders, hands, light, lenses, files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uika.data.surface_items import CODE_STEP, SurfaceItem
from uika.train.augment import degrade

_TURN, _WILD_TURN, _WILD = 10.0, 40.0, 0.03  # degrees of a crop's turn, of the odd one, and how often that is
_SIDE, _SHIFT = (0.95, 1.4), 0.06  # side of the crop over that of the item, and its shift
_MIRROR = 0.5
_BODY, _FOUND, _PLAIN, _WHITE = 0.75, 0.8, 0.97, 0.92
_COLOURLESS, _SHADE, _STREAK = 0.1, 0.5, 0.5
_SMOOTH = 24  # cells of noise


class SurfaceBatch(NamedTuple):
    """B pictures of S x S pixels with labels of L x L."""

    image: Tensor  # [B,3,S,S] in [0,1]
    code: Tensor  # [B,4,L,L]
    shown: Tensor  # [B,L,L] int64: 0 no part of the head, 1 skin, 2 hair
    person: Tensor  # [B,L,L] matte


def make_batch(items: list[SurfaceItem], size: int, labels: int, seed: int, augment: bool = True) -> SurfaceBatch:
    """Items as a batch; the same for the same seed. Without `augment`: centred crops, exact mattes, white behind."""
    rows = [_one(item, size, labels, np.random.default_rng([seed, row]), augment) for row, item in enumerate(items)]
    return SurfaceBatch(*(torch.stack(parts) for parts in zip(*rows, strict=True)))


def _one(
    item: SurfaceItem, size: int, labels: int, random: np.random.Generator, augment: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    matrix = _crop(random) if augment else torch.tensor([[1.12, 0.0, 0.0], [0.0, 1.12, 0.0]])
    planes = torch.cat((item.image, item.mask[None], item.matte[None])).float() / 255
    whole = torch.ones_like(planes[:1])
    planes = _sampled(torch.cat((planes, whole)), matrix, size, "bilinear")
    image, mask, matte, inside = planes[:3], planes[3], planes[4], planes[5]
    image = image / inside.clamp_min(1e-3)
    known = torch.cat((item.code.float() * CODE_STEP, item.shown[None].float()))
    known = _sampled(known, matrix, labels, "nearest")
    code, shown = known[:4], known[4]
    if not augment:
        return image * mask + 1 - mask, code, shown.long(), _fewer(mask, labels)
    behind = _texture(size, random) if random.random() < 0.5 else image
    image = torch.where(inside > 0.999, image, behind)
    image, hidden, body = _dressed(image, mask, random)
    person = _errors(torch.maximum(matte, body), torch.maximum(mask, body), random)
    image, before = _occluded(image, random)
    image = _lit(_streaked(image, _more(shown == 2, size), random), random)
    hidden = torch.maximum(hidden, before)
    plain = torch.ones(3) if random.random() < _WHITE else torch.from_numpy(random.uniform(0, 1, 3)).float()
    if random.random() < _PLAIN:
        image = image * person + plain[:, None, None] * (1 - person)
    image = degrade(image, random)
    shown = shown * (_fewer(hidden, labels) < 0.5)
    return image.clamp(0, 1), code, shown.long(), _fewer(person, labels)


def mirrored(batch: SurfaceBatch, rows: Tensor) -> SurfaceBatch:
    """The batch with the pictures `rows` [B] (bool) mirrored; the head's two sides are alike."""
    image, code, shown, person = (torch.where(_wide(rows, part), part.flip(-1), part) for part in batch)
    side = torch.where(rows, -1.0, 1.0)
    return SurfaceBatch(image, torch.cat((code[:, :1] * side[:, None, None, None], code[:, 1:]), 1), shown, person)


def _crop(random: np.random.Generator) -> Tensor:
    """Affine map [2,3] from crop to item, both in [-1,1]."""
    turn = np.deg2rad(random.normal(0, _WILD_TURN if random.random() < _WILD else _TURN))
    side = random.uniform(*_SIDE)
    stretch = np.exp(random.normal(0, 0.03))
    x, y = random.uniform(-2 * _SHIFT, 2 * _SHIFT, 2)
    c, s = np.cos(turn), np.sin(turn)
    return torch.tensor([[side * c * stretch, -side * s, x], [side * s, side * c / stretch, y]], dtype=torch.float32)


def _sampled(planes: Tensor, matrix: Tensor, size: int, mode: str) -> Tensor:
    grid = functional.affine_grid(matrix[None], [1, 1, size, size], align_corners=False)
    return functional.grid_sample(planes[None], grid, mode=mode, padding_mode="zeros", align_corners=False)[0]


def _fewer(plane: Tensor, size: int) -> Tensor:
    return functional.interpolate(plane[None, None].float(), size=(size, size), mode="area")[0, 0]


def _more(plane: Tensor, size: int) -> Tensor:
    planes = plane[None, None].float()
    return functional.interpolate(planes, size=(size, size), mode="bilinear", align_corners=False)[0, 0]


def _noise(size: int, cells: tuple[int, int], channels: int, random: np.random.Generator) -> Tensor:
    """Smooth noise [C,S,S] of deviation about 1."""
    coarse = torch.from_numpy(random.normal(size=(1, channels, *cells)).astype(np.float32))
    if max(cells) < _SMOOTH:  # few cells would show their edges
        coarse = functional.interpolate(coarse, size=(_SMOOTH, _SMOOTH), mode="bicubic", align_corners=False)
    return functional.interpolate(coarse, size=(size, size), mode="bilinear", align_corners=False)[0]


def _texture(size: int, random: np.random.Generator) -> Tensor:
    """Something coloured [3,S,S]: cloth, wall, scenery."""
    base = torch.from_numpy(random.uniform(0, 1, (3, 1, 1))).float()
    cells = (int(random.integers(1, 24)), int(random.integers(1, 24)))
    grain = _noise(size, cells, 1, random) * random.uniform(0, 0.2) + _noise(size, (4, 4), 3, random) * 0.1
    return (base + grain).clamp(0, 1)


def _dressed(image: Tensor, mask: Tensor, random: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Shoulders behind the head's neck, mostly: the picture, what they hide of the head, and where they are [S,S]."""
    size = mask.shape[-1]
    none = torch.zeros_like(mask)
    rows = (mask > 0.5).any(1).nonzero()[:, 0]
    if random.random() > _BODY or len(rows) == 0:
        return image, none, none
    bottom, top = int(rows[-1]), int(rows[0])
    columns = (mask[max(bottom - 4, 0) : bottom + 1] > 0.5).any(0).nonzero()[:, 0].float()
    middle, height = float(columns.mean()), bottom - top
    place = torch.arange(size) + 0.5
    y, x = torch.meshgrid(place, place, indexing="ij")
    half = height * random.uniform(0.5, 1.0)
    slope = random.uniform(0.1, 0.6)
    start = bottom - height * random.uniform(0.0, 0.22)
    across = (x - middle - height * random.uniform(-0.1, 0.1)).abs()
    drop = slope * across + height * 0.6 * ((across - half).clamp_min(0) / (0.3 * half)) ** 2
    body = (y - start - drop).div(1.5).sigmoid()
    cloth = _texture(size, random)
    skin = (y - start < height * random.uniform(0, 0.12)) & (across < height * random.uniform(0.1, 0.4))
    if random.random() < 0.5 and bool((mask > 0.9).any()):
        near = mask[max(bottom - 8, 0) : bottom + 1] > 0.9
        tone = image[:, max(bottom - 8, 0) : bottom + 1][:, near]
        if tone.shape[1]:
            cloth = torch.where(skin, tone.mean(1)[:, None, None] + 0.03 * _noise(size, (6, 6), 1, random), cloth)
    collar = body * (y > bottom - height * random.uniform(0, 0.18)) if random.random() < 0.5 else none
    front = torch.maximum((1 - mask) * body, collar)
    return image * (1 - front) + cloth * front, collar, body


def _errors(found: Tensor, exact: Tensor, random: np.random.Generator) -> Tensor:
    """A matte [S,S] as good as those in use: the one found, or the exact one grown, shrunk, holed or leaking."""
    matte = found if random.random() < _FOUND else exact
    size = matte.shape[-1]
    if random.random() < 0.5:
        field = _noise(size, (5, 5), 1, random)[0]
        soft = functional.avg_pool2d(matte[None, None], 5, 1, 2, count_include_pad=False)[0, 0]
        matte = ((soft - 0.5 + 0.25 * field) * random.uniform(2, 6) + 0.5).clamp(0, 1)
    if random.random() < 0.1:
        blob = (_noise(size, (6, 6), 1, random)[0] - random.uniform(1.0, 1.8)).mul(8).clamp(0, 1)
        matte = torch.maximum(matte, blob) if random.random() < 0.6 else matte * (1 - blob)
    return matte


def _occluded(image: Tensor, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """The picture with a hand, a microphone, a hat's brim before it at times, and where that is [S,S]."""
    size = image.shape[-1]
    hidden = torch.zeros(size, size)
    while random.random() < 0.12:
        place = (torch.arange(size) + 0.5) / size
        y, x = torch.meshgrid(place, place, indexing="ij")
        cx, cy = random.uniform(0.1, 0.9, 2)
        angle, along, across = random.uniform(0, np.pi), random.uniform(0.05, 0.35), random.uniform(0.02, 0.14)
        u = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        v = (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
        inside = ((u / along).abs() ** 2.5 + (v / across).abs() ** 2.5 < 1).float()
        image = torch.where(inside > 0, _texture(size, random), image)
        hidden = torch.maximum(hidden, inside)
    return image, hidden


def _streaked(image: Tensor, hair: Tensor, random: np.random.Generator) -> Tensor:
    """Hair [S,S] with strands that the painted surface lacks."""
    if random.random() > _STREAK:
        return image
    size = image.shape[-1]
    cells = (int(random.integers(3, 12)), int(random.integers(24, 64)))
    lines = _noise(size, cells if random.random() < 0.6 else cells[::-1], 1, random)
    if random.random() < 0.5:
        lines = _sampled(lines, _crop(random), size, "bilinear")
    tint = torch.from_numpy(random.normal(0, 0.04, (3, 1, 1))).float()
    strong = random.uniform(0.05, 0.3)
    return torch.lerp(image, (image * (1 + strong * lines) + 0.05 * strong * lines + tint).clamp(0, 1), hair)


def _lit(image: Tensor, random: np.random.Generator) -> Tensor:
    """Other light, exposure, white balance and contrast; black and white at times."""
    size = image.shape[-1]
    if random.random() < _SHADE:
        cells = (int(random.integers(2, 5)), int(random.integers(2, 5)))
        image = image * (random.uniform(0.05, 0.3) * _noise(size, cells, 1, random)).exp()
    gains = np.exp(random.normal(-0.06, 0.12) + random.normal(0, 0.05, 3))
    image = (image.clamp(0, 1) ** float(np.exp(random.normal(0, 0.18)))) * torch.from_numpy(gains).float()[
        :, None, None
    ]
    image = ((image - 0.5) * float(np.exp(random.normal(0, 0.15))) + 0.5).clamp(0, 1)
    grey = image.mean(0, keepdim=True).expand(3, -1, -1)
    share = 1.0 if random.random() < _COLOURLESS else random.uniform(-0.3, 0.5)
    return torch.lerp(image, grey, share).clamp(0, 1)


def _wide(rows: Tensor, like: Tensor) -> Tensor:
    return rows.view(-1, *([1] * (like.ndim - 1)))
