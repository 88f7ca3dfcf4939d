"""The bounds that every random scene must meet, and the tables of what was measured.

`python -m tests.stress.report` reads what `make stress` left in `out/stress` and writes
`benchmarks/results/stress_*.md`.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]
RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"

BOUNDS: dict[str, dict[str, float]] = {
    "scenes": {"image": 2e-5, "alpha": 1e-5, "gradient_ratios": 16, "strayed": 0, "skip_ratio": 1},
    "gradients": {"image": 2e-5, "alpha": 1e-5, "gradients": 5e-5, "strayed": 0},
    "extreme": {"image_ratio": 16, "alpha_ratio": 16, "gradient_ratios": 16, "strayed": 0, "hidden_gradient": 0},
}
"""Most that any scene of a family may have; of gradients, any input's."""

MEANING = {
    "image": "image, largest difference from float64 (of colours up to 1, of depths up to 4)",
    "alpha": "coverage, largest difference from float64",
    "gradients": "gradient of {}, relative",
    "gradient_ratios": "gradient of {}, error over (a share of its norm + what the last bit of the inputs changes)",
    "strayed": "splats culled on one side only, no threshold near",
    "skip_ratio": "share of the bound on skipped work that a pixel used",
    "skip_error": "difference from the image of all splats, of the colours' range",
    "image_ratio": "image, error over (1e-6 + what the last bit of the inputs changes)",
    "alpha_ratio": "coverage, the same",
    "hidden_gradient": "gradient of culled splats",
}


def broken(name: str, row: Row) -> list[str]:
    """The bounds that a scene does not meet."""
    found = []
    for what, bound in BOUNDS[name].items():
        values = row[what] if isinstance(row[what], dict) else {"": row[what]}
        found += [f"{what} {key} {value}" for key, value in values.items() if not value <= bound]
    return found


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines) + "\n"


def _worst(rows: list[Row], value: Callable[[Row], float]) -> tuple[float, str]:
    row = max(rows, key=value)
    return value(row), row["unit"]


def scenes(found: dict[str, list[Row]]) -> str:
    """Worst errors of the random scenes, family by family."""
    text = []
    for name, bounds in BOUNDS.items():
        rows = found[name]
        lines = []
        for what in [*bounds, *(extra for extra in ("skip_error",) if extra in rows[0])]:
            bound = f"{bounds[what]:g}" if what in bounds else ""
            inputs = sorted({key for row in rows for key in row[what]}) if isinstance(rows[0][what], dict) else [None]
            for key in inputs:
                here = [row for row in rows if key is None or key in row[what]]
                worst, seed = _worst(here, lambda row, w=what, k=key: row[w] if k is None else row[w][k])
                lines.append((MEANING[what].format(f"`{key}`"), f"{worst:.1e}" if worst else 0, bound, seed))
        failed = sum(bool(broken(name, row)) for row in rows)
        text.append(f"{TITLES[name]}: {len(rows):,} scenes, {failed} beyond a bound.\n")
        text.append(_table(("what", "worst", "bound", "seed"), lines))
    return "\n".join(text)


TITLES = {
    "scenes": "Ordinary scenes, every mode",
    "gradients": "Scenes in which every input takes part",
    "extreme": "Extreme scenes (18 orders of magnitude in sizes and quaternions, thresholds hit exactly)",
}


def fuzz(rows: list[Row]) -> str:
    """Damaged files by reader."""
    lines = []
    for name in sorted({row["target"] for row in rows}):
        here = [row for row in rows if row["target"] == name]
        read, refused, findings = (sum(r[k] if k != "findings" else len(r[k]) for r in here) for k in COUNTS)
        slowest, grown = max(row["slowest"] for row in here), max(row["grown"] for row in here)
        lines.append((name, f"{read + refused:,}", f"{read:,}", f"{refused:,}", findings, f"{slowest:.2f}", grown))
    total = sum(row["read"] + row["refused"] for row in rows)
    head = ("reader", "files", "read", "refused by name", "findings", "slowest, s", "most memory, MiB")
    return f"{total:,} damaged files.\n\n" + _table(head, lines)


COUNTS = ("read", "refused", "findings")


def catalogue(tests: dict[str, Row]) -> str:
    """Each line of the catalogue, its tests and what they measured."""
    from .catalogue import ELSEWHERE, LINES

    lines = []
    for number, what in LINES.items():
        names = [name for name in tests if re.search(rf"::test_{number:02}_", name)]
        names += [name for place in ELSEWHERE.get(number, ()) for name in tests if name.startswith(place)]
        for name in names:
            values = "; ".join(
                f"{key} {value:.1e}" if value else f"{key} 0" for key, value in tests[name]["worst"].items()
            )
            lines.append((number, what, f"`{name.split('::')[-1]}`", _ends(tests[name]), values))
    return _table(("line", "input", "test", "cases", "worst"), lines)


def faults(tests: dict[str, Row]) -> str:
    """Each fault that was produced, and how the test of it ended."""
    lines = []
    for name in tests:
        if not name.startswith(("tests/stress/test_faults.py", "tests/stress/test_stops.py")):
            continue
        sentence = name.split("::test_")[1].replace("_", " ")
        lines += [(sentence, case, outcome) for case, outcome in tests[name]["cases"].items()]
    measured = [
        f"{what} {value:.2f}" for name in tests for what, value in tests[name]["worst"].items() if "to end" in what
    ]
    text = _table(("what must hold", "case", "outcome"), lines)
    return text + ("\n" + "; ".join(measured) + ".\n" if measured else "")


def _ends(test: Row) -> str:
    ends = list(test["cases"].values())
    return ", ".join(f"{ends.count(end)} {end}" for end in sorted(set(ends)))


def main() -> int:
    """Write the tables; exit code 1 if any scene broke a bound."""
    from .campaign import FOLDER, rows

    found = {name: rows(name) for name in (*BOUNDS, "fuzz")}
    tests: dict[str, Row] = json.loads((FOLDER / "tests.json").read_text())
    texts = {
        "scenes": scenes(found),
        "fuzz": fuzz(found["fuzz"]),
        "catalogue": catalogue(tests),
        "faults": faults(tests),
    }
    for name, text in texts.items():
        (RESULTS / f"stress_{name}.md").write_text(text)
    return int(any(broken(name, row) for name in BOUNDS for row in found[name]))


if __name__ == "__main__":
    sys.exit(main())
