"""Families of random scenes: ordinary ones that must match the oracle closely, extreme ones that must stay sane."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from drjit_splat import reference
from tests.drjit_splat.common import Comparison, random_scene

# Few sizes: each one compiles its own kernels.
SIZES = ((32, 32), (33, 21))
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


@dataclass(frozen=True)
class Case:
    """Arguments of one call."""

    scene: dict[str, Tensor]
    width: int
    height: int
    options: dict[str, Any]


def turned(view: Tensor, rng: random.Random) -> Tensor:
    """A view matrix turned by up to 0.3 radians about a random axis."""
    axis = torch.tensor([rng.gauss(0, 1) for _ in range(3)])
    x, y, z = (axis / axis.norm() * rng.uniform(0, 0.3)).tolist()
    turn = torch.eye(4)
    turn[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    return turn @ view


def ordinary(seed: int) -> Case:
    """Mixed sizes, one or two turned cameras with off-centre lenses, every mode, colours or harmonics."""
    rng = random.Random(seed)
    width, height = rng.choice(SIZES)
    channels, cameras, mode = rng.choice((1, 3, 3, 5)), rng.choice((1, 1, 2)), rng.choice(MODES)
    options: dict[str, Any] = {"render_mode": mode, "rasterize_mode": rng.choice(("classic", "antialiased"))}
    harmonics = rng.random() < 0.3
    count = rng.choice((1, 7, 60, 200))
    scene = random_scene(count, width, height, 3 if harmonics else channels, cameras, seed)
    g = torch.Generator().manual_seed(seed)
    if harmonics:
        options["sh_degree"] = rng.randrange(4)
        scene["colors"] = 0.3 * torch.randn(count, (options["sh_degree"] + 1) ** 2, 3, generator=g)
    scene["scales"] *= rng.choice((0.3, 1.0, 3.0))
    scene["opacities"] *= rng.choice((0.1, 1.0))
    scene["viewmats"] = torch.stack([turned(view, rng) for view in scene["viewmats"]])
    scene["Ks"][:, :2, 2] += (torch.rand(cameras, 2, generator=g) - 0.5) * width
    scene["Ks"][:, :2, :2] *= rng.choice((0.5, 1.0, 2.0))
    if rng.random() < 0.3 or mode in ("D", "ED"):
        del scene["backgrounds"]
    return Case(scene, width, height, options)


def graded(seed: int) -> Case:
    """Every input takes part: each mode with colours and harmonics, rotations or covariances, backgrounds, 2 cameras.

    A hundred consecutive seeds go through all combinations.
    """
    place, mode = divmod(seed, len(MODES))
    place, kind = divmod(place, 5)
    place, raster = divmod(place, 2)
    rng = random.Random(seed)
    width, height = rng.choice(SIZES)
    count, cameras = rng.choice((60, 120, 200)), rng.choice((1, 2))
    scene = random_scene(count, width, height, 3, cameras, seed)
    options: dict[str, Any] = {"render_mode": MODES[mode], "rasterize_mode": ("classic", "antialiased")[raster]}
    g = torch.Generator().manual_seed(seed)
    if kind:
        options["sh_degree"] = kind - 1
        scene["colors"] = 0.3 * torch.randn(count, kind * kind, 3, generator=g)
    scene["viewmats"] = torch.stack([turned(view, rng) for view in scene["viewmats"]])
    scene["Ks"][:, :2, 2] += 0.3 * (torch.rand(cameras, 2, generator=g) - 0.5) * width
    if place % 2:
        root = reference.quats_to_rotations(scene.pop("quats")) * scene.pop("scales")[:, None, :]
        scene["covars"] = root @ root.mT
        options |= {"quats": None, "scales": None}
    return Case(scene, width, height, options)


def _spread(count: int, low: float, high: float, g: torch.Generator) -> Tensor:
    """Powers of ten between two exponents."""
    return 10 ** (low + (high - low) * torch.rand(count, generator=g))


def extreme(seed: int) -> Case:
    """All that is allowed at once: 18 orders of magnitude in sizes and lengths, opacities at their limits."""
    rng = random.Random(seed)
    width, height = rng.choice(SIZES)
    count = rng.choice((3, 40, 150))
    scene = random_scene(count, width, height, 3, 1, seed)
    g = torch.Generator().manual_seed(seed)
    scene["scales"] = _spread(3 * count, -10, rng.choice((0.0, 2.0, 8.0)), g).view(count, 3)
    scene["quats"] *= _spread(count, -12, 6, g)[:, None]
    far = _spread(count, -3, rng.choice((1.0, 4.0)), g)[:, None] * torch.randn(count, 3, generator=g)
    scene["means"] = torch.where(torch.rand(count, 1, generator=g) < 0.5, far, scene["means"])
    limits = torch.tensor([0.0, 1e-7, 1 / 255, math.nextafter(1 / 255, 1), 0.999, 1.0])
    chosen = limits[torch.randint(len(limits), (count,), generator=g)]
    # A splat of 1/255 over the whole image puts every pixel at a threshold, where nothing can be compared.
    at_limit = (torch.rand(count, generator=g) < 0.5) & (scene["scales"].amax(-1) < 1)
    scene["opacities"] = torch.where(at_limit, chosen, scene["opacities"])
    scene["viewmats"] = torch.stack([turned(view, rng) for view in scene["viewmats"]])
    scene["Ks"][:, :2, :2] *= rng.choice((0.05, 1.0, 30.0))
    shift = rng.choice((0.0, 5.0 * width, -width))
    scene["Ks"][:, :2, 2] += shift
    if rng.random() < 0.8:  # half of what would lie beside the image stays in it
        aside = torch.rand(count, generator=g) < 0.5
        scene["means"][aside, :2] -= shift / scene["Ks"][0, 0, 0] * 2
    options = {
        "eps2d": rng.choice((0.0, 1e-6, 0.3)),
        "rasterize_mode": rng.choice(("classic", "antialiased")),
        "render_mode": rng.choice(MODES[:1] + MODES[3:]),
    }
    return Case(scene, width, height, options)


def noted(worst: Callable[[str, float], float], c: Comparison) -> Comparison:
    """The comparison, after its errors were added to the table of the worst."""
    worst("image", c.image)
    worst("coverage", c.alpha)
    worst("gradient", max(c.gradients.values(), default=0.0))
    return c
