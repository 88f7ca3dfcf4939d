"""The bounds that every random scene must meet, and the table of what was measured.

`python -m tests.stress.report` reads `out/stress/*.jsonl` (see `tests.stress.campaign`) and the worst values that
`make stress` wrote, and writes `benchmarks/results/stress.md`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

Row = dict[str, Any]
TESTS = Path(__file__).resolve().parent
TARGET = TESTS.parents[1] / "benchmarks" / "results" / "stress.md"
CATALOGUE = TESTS / "catalogue.txt"

BOUNDS: dict[str, dict[str, float]] = {
    "scenes": {"image": 2e-5, "alpha": 1e-5, "gradient_ratios": 16, "strayed": 0, "skip_ratio": 1},
    "gradients": {"image": 2e-5, "alpha": 1e-5, "gradients": 5e-5, "strayed": 0},
    "extreme": {"image_ratio": 16, "alpha_ratio": 16, "gradient_ratios": 16, "strayed": 0, "hidden_gradient": 0},
}
"""Most that any scene of a family may have; of gradients, any input's."""


def broken(name: str, row: Row) -> list[str]:
    """The bounds that a scene does not meet."""
    found = []
    for what, bound in BOUNDS[name].items():
        values = row[what] if isinstance(row[what], dict) else {"": row[what]}
        found += [f"{what} {key} {value}" for key, value in values.items() if not value <= bound]
    return found
