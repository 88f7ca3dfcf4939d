"""Hair and beards: where they grow, how far they stand off the head, and what they look like on the atlas."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scenes.people.fields import Fields
from scenes.people.noise import fractal_noise, smoothstep, value_noise
from scenes.people.person import Cut, Person
from uika.head import HeadModel, HeadParameters, shaped_vertices, vertex_normals

# Side view of the hairline in front of the ears: height -> depth z at which hair begins, metres on the template.
_LINE_Y = (-0.02, 0.0, 0.02, 0.04, 0.055, 0.066, 0.09)
_LINE_Z = (-0.024, -0.014, 0.004, 0.02, 0.038, 0.053, 0.09)
_NAPE, _BEHIND_EAR = -0.07, -0.071
_EAR = (-0.006, -0.048, 0.032, 0.022)  # centre y, z and radii
_AXIS_Z = -0.035  # of the vertical axis through the head
_SHELL = (0.084, 0.098)  # half width and half depth of the head at its widest

# Thickness on top and at the sides, lumpiness, all in metres; how low it hangs, or None.
_STYLE: dict[Cut, tuple[float, float, float, float | None]] = {
    "bald": (0.0, 0.0, 0.0, None),
    "buzz": (0.0025, 0.002, 0.0, None),
    "short": (0.017, 0.007, 0.003, None),
    "side": (0.026, 0.009, 0.004, None),
    "afro": (0.048, 0.042, 0.005, None),
    "curly": (0.032, 0.024, 0.011, None),
    "bob": (0.022, 0.018, 0.003, -0.085),
    "long": (0.02, 0.016, 0.005, -0.15),
    "bun": (0.008, 0.006, 0.001, None),
    "receding": (0.006, 0.006, 0.001, None),
    "fringe": (0.02, 0.017, 0.003, -0.06),
}


def hair_offsets(person: Person, head: HeadModel) -> Tensor:
    """How far hair and beard push the vertices out, [V,3] metres on the unposed head."""
    random = torch.Generator().manual_seed(person.seed * 5 + 3)
    rest = HeadParameters.zeros(head).replace(identity=person.shape)
    vertices = shaped_vertices(head, rest)
    normals = vertex_normals(vertices, head.faces)
    points = head.template
    inside = hairline(points, person)
    # The hair's own edge lies within the painted hair, so that no skin is drawn out with it.
    grown = smoothstep(0.003, 0.015, inside)
    top, side, lumps, bottom = _STYLE[person.cut]
    height = smoothstep(0.02, 0.085, points[:, 1])
    thick = side + (top - side) * height
    if person.cut == "side":
        thick = thick * (1 + 0.45 * torch.tanh(points[:, 0] / 0.02) * height)
    noise = fractal_noise(points, 45.0, random, 2)
    thick = thick * float(0.8 + 0.5 * torch.rand((), generator=random)) + lumps * noise
    lifted = torch.nn.functional.normalize(normals + torch.tensor([0.0, 0.35, -0.1]), dim=-1)
    offset = thick.clamp_min(0)[:, None] * lifted
    if bottom is not None:
        grown = smoothstep(0.001, 0.008, inside)
        offset = offset + _hang(vertices, points, bottom, random)
    if person.cut == "bun":
        bun = torch.tensor([0.0, 0.075 + 0.03 * float(torch.rand((), generator=random)), -0.125])
        offset = offset + 0.045 * torch.exp(-(((points - bun).norm(dim=-1) / 0.026) ** 2))[:, None] * normals
    if person.cut == "fringe":
        offset = offset + _fringe(points)
    beard = beard_cover(points, head.masks["mouth_inner"], person)
    depth = {"full": 0.009, "goatee": 0.006, "moustache": 0.004}.get(person.beard, 0.0)
    fluff = depth * (1 + 0.4 * value_noise(points, 60.0, random))
    down = torch.nn.functional.normalize(normals + torch.tensor([0.0, -0.4, 0.0]), dim=-1)
    return grown[:, None] * offset + (beard * fluff)[:, None] * down


def hairline(points: Tensor, person: Person) -> Tensor:
    """Signed distance [N] in metres into the hair of template points [N,3]; negative on bare skin."""
    x, y, z = points.unbind(-1)
    if person.cut == "bald":
        return torch.full_like(x, -0.1)
    front = torch.from_numpy(np.interp(y.numpy(), _LINE_Y, _LINE_Z)).float()
    # A widow's peak in the middle and receding corners beside it.
    peak = (
        0.006 * torch.exp(-((x / 0.012) ** 2))
        - 0.008 * torch.exp(-(((x.abs() - 0.035) / 0.014) ** 2)) * person.masculine
    )
    upper = torch.minimum(front - z + peak, y + 0.02)
    lower = torch.minimum(_BEHIND_EAR - z, y - _NAPE)
    inside = torch.maximum(upper, lower)
    if person.cut == "receding":
        bare = 0.062 - y - 0.25 * (z + 0.03).clamp_max(0)
        inside = torch.minimum(inside, bare)
    return torch.where(x.abs() > 0.05, torch.minimum(inside, _ear(points)), inside)


def beard_cover(points: Tensor, mouth_inner: Tensor, person: Person) -> Tensor:
    """How densely [N] in [0,1] a beard grows at template points [N,3]."""
    x, y, z = points.unbind(-1)
    if person.beard == "none":
        return torch.zeros_like(x)
    jaw = torch.minimum(-0.004 - 0.95 * z.clamp_min(0) - y, z + 0.022)
    jaw = torch.minimum(torch.minimum(jaw, y + 0.112), 0.25 * (y + 0.125) + 0.02)
    lip = torch.minimum(0.028 - x.abs(), torch.minimum(-0.0415 - y, y + 0.068))
    chin = torch.minimum(0.021 - x.abs(), torch.minimum(-0.07 - y, torch.minimum(y + 0.112, z - 0.03)))
    around = torch.minimum(0.033 - x.abs(), torch.minimum(x.abs() - 0.021, torch.minimum(-0.05 - y, y + 0.09)))
    region = {
        "moustache": lip,
        "goatee": torch.maximum(torch.maximum(lip, chin), around),
    }.get(person.beard, torch.maximum(jaw, lip))
    return smoothstep(-0.003, 0.006, region) * (mouth_inner < 0.5) * (z > -0.05)


def hair_strands(fields: Fields, person: Person, generator: torch.Generator) -> Tensor:
    """Brightness [M] of the hair about 1, streaked along the way it is combed."""
    points = fields.points
    if person.cut in ("afro", "curly"):
        tight = 260.0 if person.cut == "afro" else 130.0
        return (
            1
            + 0.5 * (value_noise(points, tight, generator).abs() - 0.4)
            + 0.25 * fractal_noise(points, 500.0, generator, 2)
        )
    combed_side = person.cut in ("side", "bob", "long")
    sides = fractal_noise(points, (330.0, 26.0, 330.0), generator, 3)
    top = fractal_noise(points, (30.0, 330.0, 330.0) if combed_side else (330.0, 330.0, 30.0), generator, 3)
    up = smoothstep(0.45, 0.85, fields.normals[:, 1])
    tufts = fractal_noise(points, (60.0, 20.0, 60.0), generator, 2)
    return (1 + 0.42 * (sides * (1 - up) + top * up) + 0.15 * tufts).clamp(0.15, 2.2)


def _ear(points: Tensor) -> Tensor:
    """Distance in metres outside the ears, as seen from the side."""
    y, z, height, width = _EAR
    reach = torch.sqrt(((points[:, 1] - y) / height) ** 2 + ((points[:, 2] - z) / width) ** 2)
    return (reach - 1) * 0.027


def _hang(vertices: Tensor, points: Tensor, bottom: float, generator: torch.Generator) -> Tensor:
    """Offsets [V,3] that let the hair below the temples fall as a curtain to the height `bottom`."""
    y, z = points[:, 1], points[:, 2]
    low = 0.024 + (_NAPE + 0.02 - 0.024) * smoothstep(-0.058, -0.08, z)
    start = 0.062
    fall = ((start - y) / (start - low)).clamp(0, 1)
    # Cut in an even line, somewhat shorter towards the face.
    reach = (
        (start - bottom) * (1 - 0.22 * smoothstep(-0.04, -0.01, z)) * (1 + 0.04 * value_noise(points, 25.0, generator))
    )
    level = start - fall * reach
    flat = torch.stack((vertices[:, 0], vertices[:, 2] - _AXIS_Z), -1)
    radius = flat.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    direction = flat / radius
    shell = 1 / (direction / torch.tensor(_SHELL)).norm(dim=-1, keepdim=True)
    outward = (shell * (1 - 0.05 * fall[:, None]) - radius).clamp_min(0) * smoothstep(0.0, 0.35, fall)[:, None]
    sideways = direction * outward
    back = -0.022 * fall * (z > -0.04)
    down = torch.where(fall > 0, level - y, torch.zeros_like(y))
    return torch.stack((sideways[:, 0], down, sideways[:, 1] + back), -1)


def _fringe(points: Tensor) -> Tensor:
    """Offsets [V,3] that comb the hair above the forehead down over it."""
    x, y, z = points.unbind(-1)
    amount = smoothstep(0.015, 0.04, z) * smoothstep(0.1, 0.075, y) * smoothstep(0.055, 0.04, x.abs())
    return amount[:, None] * torch.tensor([0.0, -0.026, 0.014])
