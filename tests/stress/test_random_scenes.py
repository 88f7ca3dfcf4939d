"""Images and all gradients of random scenes against the float64 oracle; 10,000 and 200 extreme ones in the long run."""

from __future__ import annotations

import os

import pytest
import torch

from tests.drjit_splat.common import compare, render_with_gradients

from .conftest import LONG, Worst
from .scenes import extreme, noted, ordinary

ORDINARY = int(os.environ.get("UIKA_STRESS_SCENES", 10_000 if LONG else 24))
EXTREME = 200 if LONG else 16


@pytest.mark.parametrize("part", range(8))
def test_ordinary_scenes_match_the_oracle(worst: Worst, part: int) -> None:
    for seed in range(part, ORDINARY, 8):
        case = ordinary(seed)
        c = noted(worst, compare(case.scene, case.width, case.height, **case.options))
        # An expected depth is a quotient, whose gradient cancels to nothing where one splat covers a pixel alone.
        bound = 2e-2 if "ED" in case.options["render_mode"] else 5e-4
        assert c.image < 1e-4 and c.alpha < 1e-5, seed
        assert {k: e for k, e in c.gradients.items() if e > bound} == {}, seed
        worst("share of pixels near a threshold", 1 - c.trusted)


@pytest.mark.parametrize("part", range(4))
def test_extreme_scenes_stay_finite_and_in_range(worst: Worst, part: int) -> None:
    for seed in range(part, EXTREME, 4):
        case = extreme(seed)
        image, gradients, meta = render_with_gradients(case.scene, case.width, case.height, **case.options)
        assert torch.isfinite(image).all(), seed
        assert {k for k, g in gradients.items() if not torch.isfinite(g).all()} == set(), seed
        assert float(image[..., :3].min()) >= -1e-6 and float(image[..., :3].max()) <= 1 + 1e-5, seed
        hidden = ~meta["visible"][0]
        assert float(gradients["means"][hidden].abs().sum()) == 0, seed
        c = compare(case.scene, case.width, case.height, **case.options)
        worst("coverage of trusted pixels", c.alpha)
        assert c.alpha < 2e-3, seed
