"""The strategy of 3D Gaussian Splatting (Kerbl et al. 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .base import Optimizers, Parameters, Strategy
from .ops import duplicate, remove, reset_opa, split


@dataclass
class DefaultStrategy(Strategy):
    """Duplicate small and split large Gaussians whose mean the image pulls at, prune faint and huge ones, and now and
    then make all of them faint.

    Attributes:
        prune_opa: opacity below which a Gaussian is removed.
        grow_grad2d: gradient of the mean (in halves of the image) above which a Gaussian is duplicated or split.
        grow_scale3d: largest scale, over that of the scene, up to which it is duplicated; above, it is split.
        grow_scale2d: radius, over the image's longer side, above which it is split.
        prune_scale3d: largest scale, over that of the scene, above which it is removed (after the first reset).
        prune_scale2d: radius, over the image's longer side, above which it is removed.
        refine_scale2d_stop_iter: step up to which radii count; 0: never.
        refine_start_iter: step after which anything is refined.
        refine_stop_iter: step from which nothing is done any more.
        reset_every: steps between resets of the opacities.
        refine_every: steps between refinements.
        pause_refine_after_reset: steps after a reset without refinement.
        absgrad: take the absolute gradients (Ye et al. 2024) of `rasterization(..., absgrad=True)`; they want a larger
            `grow_grad2d`, about 0.0008.
        revised_opacity: give the parts of a split the opacity of Rota Bulo et al. 2024.
        verbose: print what was done.
        key_for_gradient: the entry of `info` whose gradient is watched.

    gsplat 1.5.3 never resets opacities, because of an operator's precedence; this strategy does, as gsplat 1.6.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    key_for_gradient: str = "means2d"

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Running statistics of a training run.

        Args:
            scene_scale: size of the scene in world units.
        """
        state: dict[str, Any] = {"grad2d": None, "count": None, "scene_scale": scene_scale}
        return state | ({"radii": None} if self.refine_scale2d_stop_iter > 0 else {})

    def step_pre_backward(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Call before `loss.backward()` with the `info` of `rasterization`."""
        info[self.key_for_gradient].retain_grad()

    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Call after `loss.backward()`.

        Args:
            params: the Gaussians.
            optimizers: of each trainable parameter.
            state: what `initialize_state` gave.
            step: number of this step.
            info: meta of this step's call of `rasterization`.
            packed: whether that call was packed.
        """
        if step >= self.refine_stop_iter:
            return
        self._watch(params, state, info, packed)
        paused = step % self.reset_every < self.pause_refine_after_reset
        if step > self.refine_start_iter and step % self.refine_every == 0 and not paused:
            duplicated, halved = self._grow(params, optimizers, state, step)
            pruned = self._prune(params, optimizers, state, step)
            if self.verbose:
                print(
                    f"Step {step}: {duplicated} Gaussians duplicated, {halved} split, {pruned} pruned; "
                    f"{len(params['means'])} now."
                )
            for name in ("grad2d", "count", "radii"):
                if name in state:
                    state[name].zero_()
        if step > 0 and step % self.reset_every == 0:
            reset_opa(params, optimizers, state, 2 * self.prune_opa)

    @torch.no_grad()
    def _watch(self, params: Parameters, state: dict[str, Any], info: dict[str, Any], packed: bool) -> None:
        """Add this step's gradients to the statistics of the visible Gaussians."""
        watched: Tensor = info[self.key_for_gradient]
        gradients: Tensor | None = watched.absgrad if self.absgrad else watched.grad  # type: ignore[attr-defined]
        if gradients is None:
            raise ValueError(
                f"info[{self.key_for_gradient!r}] has no gradient: call step_pre_backward before backward()"
            )
        size = torch.tensor([info["width"], info["height"]], device=gradients.device)
        gradients = gradients * (0.5 * info["n_cameras"] * size)
        radii = info["radii"]
        if packed:
            index = info["gaussian_ids"]
        else:
            seen = (radii > 0).all(-1)
            index, gradients, radii = seen.nonzero()[:, -1], gradients[seen], radii[seen]
        count = len(params["means"])
        for name in ("grad2d", "count", "radii"):
            if name in state and state[name] is None:
                state[name] = torch.zeros(count, device=gradients.device)
        state["grad2d"].index_add_(0, index, gradients.norm(dim=-1))
        state["count"].index_add_(0, index, torch.ones_like(index, dtype=torch.float32))
        if "radii" in state:
            share = radii.amax(-1) / float(max(info["width"], info["height"]))
            state["radii"].scatter_reduce_(0, index, share, "amax")

    def _grow(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int) -> tuple[int, int]:
        """Duplicate and split; returns how many."""
        pulled = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        small = params["scales"].detach().exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        twice, halved = pulled & small, pulled & ~small
        if step < self.refine_scale2d_stop_iter:
            halved |= state["radii"] > self.grow_scale2d
        counts = int(twice.sum()), int(halved.sum())
        if counts[0]:
            duplicate(params, optimizers, state, twice)
        if counts[1]:
            halved = torch.cat([halved, halved.new_zeros(counts[0])])
            split(params, optimizers, state, halved, self.revised_opacity)
        return counts

    def _prune(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int) -> int:
        """Remove faint and huge ones; returns how many."""
        gone = params["opacities"].detach().flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            gone |= params["scales"].detach().exp().amax(-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                gone |= state["radii"] > self.prune_scale2d
        count = int(gone.sum())
        if count:
            remove(params, optimizers, state, gone)
        return count
