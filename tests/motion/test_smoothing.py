"""Smoothing takes jitter away and keeps movement in place."""

import math

import pytest
import torch

from uika.motion import Motion
from uika.motion.smoothing import one_euro, smoothed


def still(frames: int) -> dict[str, torch.Tensor]:
    sizes = {"expression": 2, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    return {name: torch.zeros(frames, size) for name, size in sizes.items()}


def test_jitter_goes_and_movement_stays() -> None:
    time = torch.arange(200) / 50.0
    clean = 0.3 * torch.sin(2 * math.pi * 0.5 * time)[:, None].expand(-1, 3)
    noisy = clean + 0.01 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    motion = Motion(fps=50.0, **{**still(200), "rotation": noisy})
    result = smoothed(motion).rotation
    assert (result - clean).square().mean() < 0.7 * (noisy - clean).square().mean()
    shifted = [torch.stack((result[5:-5, 0], clean[5 + k : 195 + k, 0])) for k in range(-4, 5)]
    lags = [float(torch.corrcoef(pair)[0, 1]) for pair in shifted]
    assert int(torch.tensor(lags).argmax()) == 4


def test_constants_and_infinite_cutoff_are_kept() -> None:
    motion = Motion(fps=25.0, **{**still(9), "expression": torch.full((9, 2), 0.37)})
    torch.testing.assert_close(smoothed(motion).expression, motion.expression)
    assert smoothed(motion, math.inf) is motion
    with pytest.raises(ValueError, match="min_cutoff"):
        smoothed(motion, 0.0)


def test_faster_signals_pass_more() -> None:
    jump = torch.cat((torch.zeros(10), torch.ones(10)))
    slow, fast = (one_euro(jump, 25.0, 1.0, gain) for gain in (0.0, 10.0))
    assert fast[11] > slow[11] + 0.2
