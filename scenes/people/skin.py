"""Painting a person on the head's atlas: linear albedo and roughness."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scenes.people.dilation import dilate
from scenes.people.fields import Fields, atlas_fields
from scenes.people.hair import beard_cover, hair_strands, hairline
from scenes.people.noise import fractal_noise, smoothstep, value_noise
from scenes.people.person import Person
from uika.head import HeadModel

_BLOODLESS = (0.86, 0.74, 0.67)  # linear albedo of skin without pigments
_MELANIN = (1.45, 2.05, 2.5)  # absorption of red, green and blue
_BLOOD = (0.06, 0.55, 0.42)
_SCLERA = (0.66, 0.62, 0.6)
_TEETH = (0.68, 0.62, 0.52)
_GUMS = (0.34, 0.1, 0.09)
_NOSE, _CHEEK = (0.0, -0.033, 0.078), (0.045, -0.03, 0.048)
_FOLD = ((0.017, -0.036, 0.062), (0.031, -0.066, 0.05))  # from the wing of the nose past the corner of the mouth


def paint(person: Person, head: HeadModel, size: int = 1024) -> tuple[np.ndarray, np.ndarray]:
    """Paint a person.

    Args:
        person: whom to paint; the same person is painted the same way each time.
        head: a head model with face-mesh landmarks.
        size: side of the atlas in texels.

    Returns:
        Linear albedo [S,S,3] and roughness [S,S], float32, row 0 at v = 0.

    Raises:
        ValueError: the head model lacks landmarks or masks.
    """
    fields = atlas_fields(head, size)
    random = torch.Generator().manual_seed(person.seed * 5 + 1)
    albedo, rough = _skin(fields, person, random)
    inner, balls = fields.masks["mouth_inner"] >= 0.5, fields.masks["eyeballs"] >= 0.5
    # Each layer works on the texels that it can change only.
    for layer, where in (
        (_lips, (fields.lips < 0.003) & ~inner),
        (_brows, fields.brow_across.abs() < 0.012),
        (_beard, beard_cover(fields.points, fields.masks["mouth_inner"], person) > 0),
        (_hair, hairline(fields.points, person) > -0.012),
        (_lids, (fields.lids < 0.03) & ~balls),
        (_mouth, inner),
        (_eyes, balls),
    ):
        index = where.nonzero()[:, 0]
        if len(index):
            albedo[index], rough[index] = layer(fields.select(index), person, random, albedo[index], rough[index])
    values = fields.binding.to_map(torch.cat((albedo, rough[:, None]), -1))
    spread = dilate(values, head, size)
    return spread[:3].permute(1, 2, 0).contiguous().numpy(), spread[3].numpy()


def _skin(fields: Fields, person: Person, random: torch.Generator) -> tuple[Tensor, Tensor]:
    points = fields.points
    blotches = fractal_noise(points, 28.0, random, 4)
    pores = fractal_noise(points, 420.0, random, 2)
    melanin = person.melanin * (1 + 0.09 * blotches + 0.05 * pores)
    if person.freckles > 0:
        spread = _blob(points, _CHEEK, 0.035) + _blob(points, (0.0, -0.01, 0.06), 0.02)
        melanin = melanin + 0.22 * person.freckles * smoothstep(0.5, 0.95, value_noise(points, 420.0, random)) * spread
    melanin = melanin + _moles(points, person)
    blood = person.haemoglobin * (1 + 0.2 * fractal_noise(points, 50.0, random, 3))
    for place, reach, gain in ((_CHEEK, 0.02, 0.35), (_NOSE, 0.011, 0.3)):
        blood = blood + gain * (0.5 + person.haemoglobin) * _blob(points, place, reach)
    blood = blood + 0.25 * fields.masks["ears"] * smoothstep(0.07, 0.082, points[:, 0].abs())
    socket = torch.exp(-((fields.lids / 0.011) ** 2))
    blood = blood + 0.15 * socket
    melanin = melanin + (0.04 + 0.1 * person.age + 0.06 * person.melanin) * socket
    melanin = melanin + 0.16 * person.age * _wrinkles(points, random) + 0.03 * person.age
    albedo = _pigmented(melanin, blood)
    shine = _blob(points, _NOSE, 0.02) + _blob(points, (0.0, 0.045, 0.06), 0.03)
    rough = 0.5 - 0.1 * shine + 0.05 * blotches + 0.04 * pores
    return albedo, rough.clamp(0.25, 0.8)


def _moles(points: Tensor, person: Person) -> Tensor:
    """Added melanin of a few small dark spots and, with age, some wider pale ones."""
    random = np.random.default_rng([person.seed, 11])
    total = torch.zeros(len(points))
    counts = ((random.poisson(3), 0.0008, 0.002, 0.9), (random.poisson(6 * person.age), 0.002, 0.004, 0.25))
    for count, small, large, strength in counts:
        for _ in range(count):
            place = points[random.integers(len(points))]
            reach = random.uniform(small, large)
            near = ((points - place).abs() < 2.5 * reach).all(-1).nonzero()[:, 0]
            square = ((points[near] - place) ** 2).sum(-1) / reach**2
            total[near] += strength * random.uniform(0.4, 1) * torch.exp(-square)
    return total


def _wrinkles(points: Tensor, random: torch.Generator) -> Tensor:
    x, y, z = points.unbind(-1)
    forehead = smoothstep(0.03, 0.04, y) * smoothstep(0.07, 0.055, y) * smoothstep(0.05, 0.03, x.abs()) * (z > 0)
    wave = torch.sin(2 * torch.pi * (y / 0.0085 + 0.35 * value_noise(points, 35.0, random)))
    lines = forehead * smoothstep(0.75, 1.0, wave)
    start, end = torch.tensor(_FOLD)
    side = torch.stack((x.abs(), y, z), -1) - start
    share = ((side @ (end - start)) / ((end - start) ** 2).sum()).clamp(0, 1)
    fold = torch.exp(-(((side - share[:, None] * (end - start)).norm(dim=-1) / 0.0025) ** 2))
    angle = torch.atan2(y - 0.008, x.abs() - 0.04)
    feet = torch.exp(-((((x.abs() - 0.056) / 0.008) ** 2) + ((y - 0.008) / 0.012) ** 2)) * (z > 0)
    feet = feet * smoothstep(0.5, 1.0, torch.sin(angle * 14))
    return lines + 1.2 * fold + feet


def _lips(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    inside = smoothstep(0.0012, -0.0012, fields.lips) * (fields.masks["mouth_inner"] < 0.5)
    lines = 0.12 * value_noise(fields.points, (500.0, 60.0, 500.0), random)
    blood = torch.as_tensor(person.haemoglobin + person.lip_redness) + lines + 0.6 * person.make_up
    colour = _pigmented(0.75 * torch.full_like(inside, person.melanin) + 0.12, blood.expand(len(inside)))
    line = torch.exp(-fields.mouth / 0.0016) * (fields.lips < 0.004)
    colour = colour * (1 - 0.6 * line[:, None])
    return _mix(albedo, colour, inside), rough + (0.33 - 0.1 * person.make_up - rough) * inside


def _brows(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    along = fields.brow_along
    width = 0.0042 * person.brow_weight * (1 - 0.65 * along.clamp(0, 1) ** 1.5)
    profile = smoothstep(1.25, 0.35, fields.brow_across.abs() / width.clamp_min(1e-4))
    ends = smoothstep(-0.08, 0.1, along) * smoothstep(1.12, 0.85, along)
    slanted = torch.stack(
        (fields.points[:, 0].abs() - 0.6 * fields.points[:, 1], fields.points[:, 1], fields.points[:, 2]), -1
    )
    hairs = fractal_noise(slanted, (700.0, 130.0, 200.0), random, 2)
    amount = profile * ends * (0.62 + 0.3 * hairs) * (0.55 + 0.45 * person.brow_weight)
    colour = 0.75 * torch.tensor(person.hair)
    return _mix(albedo, colour, amount.clamp(0, 0.95)), rough


def _beard(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    cover = beard_cover(fields.points, fields.masks["mouth_inner"], person)
    cover = cover * smoothstep(0.0, 0.0018, fields.lips)
    hairs = fractal_noise(fields.points, (420.0, 110.0, 420.0), random, 3)
    stipple = value_noise(fields.points, 700.0, random)
    amount = cover * (0.3 + 0.12 * stipple if person.beard == "stubble" else 0.85 + 0.2 * hairs)
    colour = (torch.tensor(person.hair) * 0.85)[None] * (1 + 0.25 * hairs[:, None]).clamp_min(0.2)
    return _mix(albedo, colour, amount.clamp(0, 1)), rough


def _hair(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    strands = hair_strands(fields, person, random)
    distance = (
        hairline(fields.points, person) + 0.004 * (strands - 1) + 0.002 * fractal_noise(fields.points, 150.0, random, 2)
    )
    amount = smoothstep(-0.005, 0.006, distance)
    if person.cut == "buzz":
        amount = amount * (0.7 + 0.2 * value_noise(fields.points, 600.0, random)).clamp(0, 1)
    colour = torch.tensor(person.hair) * strands[:, None]
    return _mix(albedo, colour, amount), rough + (0.44 - rough) * amount


def _lids(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    outside = (fields.masks["eyeballs"] < 0.5).float()
    shadow = torch.exp(-((fields.lids / 0.008) ** 2)) * smoothstep(0.004, 0.012, fields.points[:, 1]) * outside
    tint = torch.tensor(person.iris) * 0.5 + 0.05
    albedo = _mix(albedo, tint, 0.45 * person.make_up * shadow)
    lashes = torch.exp(-((fields.lids / (0.0011 + 0.0007 * person.make_up)) ** 2)) * outside
    return _mix(albedo, torch.tensor([0.02, 0.013, 0.01]), (0.5 + 0.4 * person.make_up) * lashes), rough


def _mouth(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    inner = (fields.masks["mouth_inner"] >= 0.5).float()
    wet = torch.tensor(_GUMS) * (1 + 0.2 * fractal_noise(fields.points, 150.0, random, 2))[:, None]
    albedo = _mix(albedo, wet, inner)
    teeth = (fields.masks["teeth"] >= 0.5).float() if "teeth" in fields.masks else torch.zeros_like(inner)
    gaps = smoothstep(0.86, 1.0, torch.cos(2 * torch.pi * fields.points[:, 0] / 0.0075).neg())
    tone = torch.tensor(_TEETH) * (1 - 0.12 * person.age * torch.tensor([0.5, 1.0, 2.0]))
    albedo = _mix(albedo, tone * (1 - 0.55 * gaps[:, None]), teeth)
    return albedo, rough + (0.25 - rough) * inner


def _eyes(
    fields: Fields, person: Person, random: torch.Generator, albedo: Tensor, rough: Tensor
) -> tuple[Tensor, Tensor]:
    ball = (fields.masks["eyeballs"] >= 0.5).float()
    r, turn = fields.iris, fields.iris_turn
    spoke = torch.stack((torch.cos(turn), torch.sin(turn), 0.35 * r), -1)
    fibres = fractal_noise(spoke, 9.0, random, 3)
    iris = torch.tensor(person.iris) * (1 + 0.5 * fibres + 0.5 * smoothstep(0.75, 0.4, r))[:, None].clamp_min(0.2)
    iris = iris * (1 - 0.7 * smoothstep(0.8, 1.0, r))[:, None]
    iris = _mix(iris, torch.full((3,), 0.004), smoothstep(0.43, 0.37, r))
    veins = smoothstep(0.15, 0.0, fractal_noise(fields.points, 220.0, random, 3).abs()) * smoothstep(1.6, 3.0, r)
    white = torch.tensor(_SCLERA) * (1 - veins[:, None] * torch.tensor([0.05, 0.3, 0.3]))
    white = white * (1 - 0.25 * smoothstep(1.8, 3.2, r))[:, None]
    eye = _mix(white, iris, smoothstep(1.06, 0.96, r))
    return _mix(albedo, eye, ball), rough + (0.12 - rough) * ball


def _pigmented(melanin: Tensor, blood: Tensor) -> Tensor:
    """Albedo [M,3] of skin with these amounts of pigments (Beer-Lambert)."""
    absorbed = melanin.clamp_min(0)[:, None] * torch.tensor(_MELANIN) + blood.clamp_min(0)[:, None] * torch.tensor(
        _BLOOD
    )
    return torch.tensor(_BLOODLESS) * torch.exp(-absorbed)


def _mix(below: Tensor, above: Tensor, amount: Tensor) -> Tensor:
    return below + (above - below) * amount[:, None]


def _blob(points: Tensor, place: tuple[float, float, float], reach: float) -> Tensor:
    """A soft spot around a place and its mirror image."""
    folded = torch.stack((points[:, 0].abs(), points[:, 1], points[:, 2]), -1)
    return torch.exp(-(((folded - torch.tensor(place)).norm(dim=-1) / reach) ** 2))
