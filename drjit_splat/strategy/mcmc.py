"""The strategy of 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .base import Optimizers, Parameters, Strategy
from .ops import inject_noise_to_position, relocate, sample_add
from .relocation import binomials


@dataclass
class MCMCStrategy(Strategy):
    """Move faint Gaussians to places of bright ones, add new ones there, and shake all means.

    Attributes:
        cap_max: most Gaussians.
        noise_lr: length of the noise over the learning rate of the means.
        refine_start_iter: step after which Gaussians are moved and added.
        refine_stop_iter: step from which they no longer are.
        refine_every: steps between.
        min_opacity: opacity up to which a Gaussian counts as dead.
        verbose: print what was done.
        noise_injection_stop_iter: step from which the means rest; -1: never.
        noise_opacity_t: opacity at which half of the noise is left.
        noise_opacity_k: how sharply it fades.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False
    noise_injection_stop_iter: int = -1
    noise_opacity_t: float = 0.005
    noise_opacity_k: float = 100.0

    def initialize_state(self) -> dict[str, Any]:
        """What the steps need: a table of binomial coefficients."""
        return {"binoms": binomials()}

    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        lr: float,
    ) -> None:
        """Call after `loss.backward()` and the optimizers' steps.

        Args:
            params: the Gaussians.
            optimizers: of each trainable parameter.
            state: what `initialize_state` gave.
            step: number of this step.
            info: not used.
            lr: current learning rate of the means.
        """
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            moved = self._relocate(params, optimizers, state)
            added = self._add(params, optimizers, state)
            if self.verbose:
                print(f"Step {step}: {moved} Gaussians relocated, {added} added; {len(params['means'])} now.")
        if self.noise_injection_stop_iter < 0 or step < self.noise_injection_stop_iter:
            scaler = lr * self.noise_lr
            inject_noise_to_position(params, optimizers, {}, scaler, self.noise_opacity_t, self.noise_opacity_k)

    def _relocate(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any]) -> int:
        dead = params["opacities"].detach().flatten().sigmoid() <= self.min_opacity
        count = int(dead.sum())
        if count:
            relocate(params, optimizers, {}, dead, state["binoms"], self.min_opacity)
        return count

    def _add(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any]) -> int:
        now = len(params["means"])
        count = max(0, min(self.cap_max, int(1.05 * now)) - now)
        if count:
            sample_add(params, optimizers, {}, count, state["binoms"], self.min_opacity)
        return count
