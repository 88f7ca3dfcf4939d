"""How the learning rate and the batch size follow the step and the number of photos."""

from __future__ import annotations

import math


def learning_rate(step: int, base: float, warmup: int, steps: int) -> float:
    """Rate of optimiser step `step` (0-based): linear warm-up, then a half cosine that is 0 in the last of `steps`."""
    if step < warmup:
        return base * (step + 1) / warmup
    if step >= steps - 1:
        return 0.0
    return base * 0.5 * (1 + math.cos(math.pi * (step + 1 - warmup) / (steps - warmup)))


def batch_size(sources: int, images: int = 16, most: int = 8) -> int:
    """Heads per process and step when each has `sources` photos: a fixed budget of `images`, at most `most` heads.

    The defaults are the released ones of the reconstructor; the estimator has 48 and 16.
    """
    return min(max(1, images // sources), most)
