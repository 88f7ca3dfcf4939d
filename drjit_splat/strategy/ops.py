"""Edits of Gaussians together with the state of their optimizers and running statistics, all in place."""

from __future__ import annotations

from collections.abc import Callable, Iterable, MutableMapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._rotations import quats_to_rotations
from .base import Optimizers, Parameters
from .relocation import compute_relocation

_MULTINOMIAL_LIMIT = 2**24  # categories that torch.multinomial takes


def _update(
    params: Parameters,
    optimizers: Optimizers,
    value: Callable[[str, Tensor], Tensor],
    moment: Callable[[Tensor], Tensor],
    names: Iterable[str] | None = None,
) -> None:
    """Replace parameters by `value(name, old)` and their optimizers' tensors of one row a Gaussian by `moment(old)`."""
    for name in list(params) if names is None else names:
        old = params[name]
        new = torch.nn.Parameter(value(name, old.detach()), requires_grad=old.requires_grad)
        params[name] = new
        if name not in optimizers:
            if old.requires_grad:
                raise ValueError(f"{name} is trainable, but there is no optimizer for it")
            continue
        optimizer = optimizers[name]
        known: dict[str, Any] = optimizer.state.pop(old, {})
        for key, entry in known.items():
            if key != "step" and isinstance(entry, Tensor):
                known[key] = moment(entry)
        optimizer.param_groups[0]["params"] = [new]
        optimizer.state[new] = known


def _update_state(state: MutableMapping[str, Any], edit: Callable[[Tensor], Tensor]) -> None:
    for key, entry in state.items():
        if isinstance(entry, Tensor):
            state[key] = edit(entry)


def _zeros(like: Tensor, rows: int) -> Tensor:
    return like.new_zeros(rows, *like.shape[1:])


def _twice(rows: Tensor) -> Tensor:
    return rows.repeat(2, *(1 for _ in rows.shape[1:]))


@torch.no_grad()
def duplicate(params: Parameters, optimizers: Optimizers, state: MutableMapping[str, Any], mask: Tensor) -> None:
    """Append a copy of the Gaussians in `mask` [N]; copies start with empty moments and inherited statistics."""
    chosen = mask.nonzero()[:, 0]
    _update(
        params,
        optimizers,
        lambda _, p: torch.cat([p, p[chosen]]),
        lambda m: torch.cat([m, _zeros(m, len(chosen))]),
    )
    _update_state(state, lambda s: torch.cat([s, s[chosen]]))


@torch.no_grad()
def split(
    params: Parameters,
    optimizers: Optimizers,
    state: MutableMapping[str, Any],
    mask: Tensor,
    revised_opacity: bool = False,
) -> None:
    """Replace each Gaussian in `mask` [N] by two, drawn from it and 1.6 times smaller, at the end.

    Args:
        params: the Gaussians.
        optimizers: of each trainable parameter.
        state: running statistics with one row a Gaussian; other values stay.
        mask: which ones.
        revised_opacity: give both the opacity whose square of the rest is the parent's rest (Rota Bulo et al. 2024).
    """
    chosen, rest = mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]
    scales = params["scales"][chosen].exp()
    rotations = quats_to_rotations(params["quats"][chosen])
    draws = torch.randn(2, len(chosen), 3, device=mask.device)
    offsets = torch.einsum("nij,nj,bnj->bni", rotations, scales, draws)

    def value(name: str, p: Tensor) -> Tensor:
        if name == "means":
            parts = (p[chosen] + offsets).reshape(-1, 3)
        elif name == "scales":
            parts = _twice((scales / 1.6).log())
        elif name == "opacities" and revised_opacity:
            parts = _twice(torch.logit(1 - (1 - p[chosen].sigmoid()).sqrt()))
        else:
            parts = _twice(p[chosen])
        return torch.cat([p[rest], parts])

    _update(params, optimizers, value, lambda m: torch.cat([m[rest], _zeros(m, 2 * len(chosen))]))
    _update_state(state, lambda s: torch.cat([s[rest], _twice(s[chosen])]))


@torch.no_grad()
def remove(params: Parameters, optimizers: Optimizers, state: MutableMapping[str, Any], mask: Tensor) -> None:
    """Remove the Gaussians in `mask` [N]."""
    kept = (~mask).nonzero()[:, 0]
    _update(params, optimizers, lambda _, p: p[kept], lambda m: m[kept])
    _update_state(state, lambda s: s[kept])


@torch.no_grad()
def reset_opa(params: Parameters, optimizers: Optimizers, state: MutableMapping[str, Any], value: float) -> None:
    """Lower all opacities to at most `value` and forget their moments."""
    most = float(torch.logit(torch.tensor(value)))
    _update(params, optimizers, lambda _, p: p.clamp(max=most), torch.zeros_like, ["opacities"])


def _draw(weights: Tensor, count: int) -> Tensor:
    """Indices [count] drawn with replacement, in proportion to the weights [N]."""
    if len(weights) <= _MULTINOMIAL_LIMIT:
        return torch.multinomial(weights, count, replacement=True)
    share = weights.double().cpu().numpy()
    return torch.from_numpy(np.random.choice(len(share), count, p=share / share.sum())).to(weights.device)


def _relocated(params: Parameters, chosen: Tensor, binoms: Tensor, min_opacity: float) -> dict[str, Tensor]:
    """Opacities and scales of each Gaussian in `chosen` once its copies share its light."""
    opacities = params["opacities"][chosen].sigmoid()
    found, scales = compute_relocation(
        opacities.flatten(),
        params["scales"][chosen].exp(),
        torch.bincount(chosen)[chosen] + 1,
        binoms,
        min_opacity,
    )
    return {"opacities": torch.logit(found).view(opacities.shape), "scales": scales.log()}


@torch.no_grad()
def relocate(
    params: Parameters,
    optimizers: Optimizers,
    state: MutableMapping[str, Any],
    mask: Tensor,
    binoms: Tensor,
    min_opacity: float = 0.005,
) -> None:
    """Move the dead Gaussians in `mask` [N] onto living ones, drawn by opacity, which share their light with them.

    Nothing happens where no Gaussian lives.
    """
    dead, alive = mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]
    if not len(dead) or not len(alive):
        return
    chosen = alive[_draw(params["opacities"].sigmoid()[alive].flatten(), len(dead))]
    changed = _relocated(params, chosen, binoms, min_opacity)

    def value(name: str, p: Tensor) -> Tensor:
        p = p.clone()
        if name in changed:
            p[chosen] = changed[name]
        p[dead] = p[chosen]
        return p

    def forgotten(rows: Tensor) -> Tensor:
        rows = rows.clone()
        rows[chosen] = 0
        return rows

    _update(params, optimizers, value, forgotten)
    _update_state(state, forgotten)


@torch.no_grad()
def sample_add(
    params: Parameters,
    optimizers: Optimizers,
    state: MutableMapping[str, Any],
    n: int,
    binoms: Tensor,
    min_opacity: float = 0.005,
) -> None:
    """Append `n` Gaussians at places of others, drawn by opacity, which share their light with them."""
    chosen = _draw(params["opacities"].sigmoid().flatten(), n)
    changed = _relocated(params, chosen, binoms, min_opacity)

    def value(name: str, p: Tensor) -> Tensor:
        p = p.clone()
        if name in changed:
            p[chosen] = changed[name]
        return torch.cat([p, p[chosen]])

    _update(params, optimizers, value, lambda m: torch.cat([m, _zeros(m, n)]))
    _update_state(state, lambda s: torch.cat([s, _zeros(s, n)]))


@torch.no_grad()
def inject_noise_to_position(
    params: Parameters,
    optimizers: Optimizers,
    state: MutableMapping[str, Any],
    scaler: float,
    t: float = 0.005,
    k: float = 100.0,
) -> None:
    """Move each mean at random within its covariance, the fainter the further (Kheradmand et al. 2024, eq. 8).

    Args:
        params: the Gaussians.
        optimizers: not used.
        state: not used.
        scaler: length of the noise.
        t: opacity at which half of the noise is left.
        k: how sharply it fades.
    """
    spread = quats_to_rotations(params["quats"]) * params["scales"].exp()[:, None]
    fading = torch.sigmoid(-k * (params["opacities"].flatten().sigmoid() - t))
    noise = torch.randn_like(params["means"]) * fading[:, None] * scaler
    params["means"].add_(torch.einsum("nij,nkj,nk->ni", spread, spread, noise))
