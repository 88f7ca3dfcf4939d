"""When to add, split, move and remove Gaussians in training: gsplat's strategies by the same names, in plain torch."""

from __future__ import annotations

from .base import Strategy
from .default import DefaultStrategy
from .mcmc import MCMCStrategy

__all__ = ["DefaultStrategy", "MCMCStrategy", "Strategy"]
