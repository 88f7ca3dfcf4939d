"""Images and all gradients of random scenes against the float64 oracle; `tests.stress.campaign` runs thousands more."""

from __future__ import annotations

import os

import pytest

from . import measure
from .conftest import Worst
from .report import BOUNDS, broken

ORDINARY = int(os.environ.get("UIKA_STRESS_SCENES", 24))
GRADED = int(os.environ.get("UIKA_STRESS_GRADIENTS", 10))
EXTREME = int(os.environ.get("UIKA_STRESS_EXTREME", 16))


def _held(name: str, row: measure.Row, worst: Worst) -> None:
    for what in BOUNDS[name]:
        value = row[what]
        worst(what, max(value.values(), default=0.0) if isinstance(value, dict) else value)
    assert broken(name, row) == []


@pytest.mark.parametrize("part", range(8))
def test_ordinary_scenes_match_the_oracle(worst: Worst, part: int) -> None:
    for seed in range(part, ORDINARY, 8):
        _held("scenes", measure.ordinary_errors(seed), worst)


@pytest.mark.parametrize("part", range(5))
def test_every_input_has_its_gradient_in_every_mode(worst: Worst, part: int) -> None:
    for seed in range(part, GRADED, 5):
        _held("gradients", measure.gradient_errors(seed), worst)


@pytest.mark.parametrize("part", range(4))
def test_extreme_scenes_are_as_good_as_their_inputs(worst: Worst, part: int) -> None:
    for seed in range(part, EXTREME, 4):
        row = measure.extreme_errors(seed)
        assert row["finite"] and row["range"][0] >= -1e-6 and row["range"][1] <= 1 + 1e-5, seed
        _held("extreme", row, worst)


# In these, gradients of huge or hair-thin splats were rounding noise, up to 10^10 times their true value.
@pytest.mark.parametrize("seed", [12, 13, 14, 20, 71, 101])
def test_extreme_scenes_that_failed_once(worst: Worst, seed: int) -> None:
    _held("extreme", measure.extreme_errors(seed), worst)
