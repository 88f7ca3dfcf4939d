"""The Gaussians of a scene while they are trained: where they start, their rates, and what is written of them."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from ..constants import SH_C0
from ..ply import save_ply
from .captures import Capture
from .config import TrainConfig

RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
LAST_RATE = 0.01  # of the means, over the first
START_OPACITY = {"default": 0.1, "mcmc": 0.5}
NEIGHBOURS = 3  # whose mean distance a Gaussian starts with as its scale
RANDOM_REACH = 1.0  # half side of the cube of random starts, over the scene's extent
CANDIDATES, ROUNDS = 20, 20  # for each random start, at most
SEEN_SHARE = 0.7  # of the most cameras that see a point; random starts are seen by more
_CHUNK = 1024
EPSILON = 1e-15


def start(capture: Capture, config: TrainConfig) -> dict[str, torch.nn.Parameter]:
    """Gaussians at the capture's points, or spread at random between its cameras, as logarithms and logits."""
    generator = torch.Generator().manual_seed(config.seed)
    if capture.points is not None and len(capture.points) > NEIGHBOURS:
        chosen = torch.randperm(len(capture.points), generator=generator)[: config.max_splats]
        means = capture.points[chosen]
        colors = torch.full_like(means, 0.5) if capture.colors is None else capture.colors[chosen]
    else:
        means = _in_view(capture, min(config.random_splats, config.max_splats), generator)
        colors = torch.rand(len(means), 3, generator=generator)
    count = len(means)
    values = {
        "means": means.clone(),
        "scales": neighbour_distances(means).clamp_min(1e-6).log()[:, None].expand(-1, 3).clone(),
        "quats": torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        "opacities": torch.full((count,), START_OPACITY[config.strategy]).logit(),
        "sh0": ((colors - 0.5) / SH_C0)[:, None].clone(),
        "shN": torch.zeros(count, (config.sh_degree + 1) ** 2 - 1, 3),
    }
    return {name: torch.nn.Parameter(value) for name, value in values.items()}


def _in_view(capture: Capture, count: int, generator: torch.Generator) -> Tensor:
    """Random points [count,3] between the cameras that most of these see: the rest of the space is mostly empty."""
    points, seen = torch.zeros(0, 3), torch.zeros(0)
    for _ in range(ROUNDS):
        cube = 2 * torch.rand(max(count * CANDIDATES, 1000), 3, generator=generator) - 1
        more = capture.centre + RANDOM_REACH * capture.extent * cube
        points, seen = torch.cat((points, more)), torch.cat((seen, _times_seen(capture, more)))
        # Where too few are seen that often, the most seen ones fill up.
        best = (-(seen >= SEEN_SHARE * seen.max()).float()).argsort(stable=True)[:count]
        if float(seen[best].min()) >= SEEN_SHARE * float(seen.max()):
            return points[best]
        kept = seen.argsort(descending=True, stable=True)[:count]
        points, seen = points[kept], seen[kept]
    return points


def _times_seen(capture: Capture, points: Tensor) -> Tensor:
    """How many photos [P] show each of the points [P,3]."""
    seen = torch.zeros(len(points))
    for photo in capture.photos:
        x, y, z = (points @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3]).unbind(-1)
        u, v = photo.K[0, 0] * x / z + photo.K[0, 2], photo.K[1, 1] * y / z + photo.K[1, 2]
        seen += (z > 0) & (u > 0) & (u < photo.width) & (v > 0) & (v < photo.height)
    return seen


def neighbour_distances(points: Tensor) -> Tensor:
    """Root mean square distance [N] of each point [N,3] to its nearest others."""
    nearest = min(NEIGHBOURS + 1, len(points))
    rows = [
        torch.cdist(part, points).topk(nearest, largest=False).values[:, 1:].square() for part in points.split(_CHUNK)
    ]
    found = torch.cat(rows)
    return found.mean(-1).sqrt() if nearest > 1 else torch.full((len(points),), 0.01)


def optimizers(
    params: dict[str, torch.nn.Parameter], extent: float, photos: int = 1
) -> dict[str, torch.optim.Optimizer]:
    """One Adam for each parameter; the means' rate is in units of the scene.

    With several `photos` a step rates grow by the root of their number and Adam forgets as fast photo by photo, as in
    gsplat's trainer.
    """
    betas = tuple(max(0.0, 1 - photos * (1 - beta)) for beta in (0.9, 0.999))
    return {
        name: torch.optim.Adam(
            [value], lr=_rate(name, extent, photos), betas=(betas[0], betas[1]), eps=EPSILON / math.sqrt(photos)
        )
        for name, value in params.items()
    }


def _rate(name: str, extent: float, photos: int) -> float:
    return RATES[name] * (extent if name == "means" else 1.0) * math.sqrt(photos)


def set_rate(chosen: dict[str, torch.optim.Optimizer], extent: float, step: int, steps: int, photos: int = 1) -> float:
    """Let the means' rate fall exponentially; returns it."""
    rate = _rate("means", extent, photos) * LAST_RATE ** (step / max(steps - 1, 1))
    chosen["means"].param_groups[0]["lr"] = rate
    return rate


def harmonics(params: dict[str, torch.nn.Parameter]) -> Tensor:
    """All harmonics [N,K,3]."""
    return torch.cat((params["sh0"], params["shN"]), 1)


@torch.no_grad()
def write(params: dict[str, torch.nn.Parameter], path: Path) -> None:
    """Write a `.ply` that splat viewers read."""
    save_ply(
        path,
        params["means"],
        torch.nn.functional.normalize(params["quats"], dim=-1),
        params["scales"].exp(),
        params["opacities"].sigmoid(),
        harmonics(params),
        comments=["trained by drjit-splat"],
    )
