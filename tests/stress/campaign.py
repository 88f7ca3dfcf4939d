"""Long runs in pieces: `python -m tests.stress.campaign scenes [--seconds 240]`, again until it says "complete".

Each finished unit is a line of `out/stress/NAME.jsonl`, so that a run goes on where the last one ended.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from . import measure
from .fuzz import fuzz
from .targets import TARGETS

FOLDER = Path("out/stress")
FUZZ_UNIT = 2000  # files that one process reads
Row = dict[str, Any]


@dataclass(frozen=True)
class Campaign:
    """Units of work by name, and what one of them measures."""

    units: list[str]
    run: Callable[[str], Row]


def _scene(measure: Callable[[int], Row]) -> Callable[[str], Row]:
    return lambda unit: measure(int(unit))


def fuzz_unit(unit: str) -> Row:
    """Damage and read `FUZZ_UNIT` files of one reader."""
    name, seed = unit.split("-")
    return asdict(fuzz(name, FUZZ_UNIT, int(seed), FOLDER / "findings"))


def _seeds(count: int) -> list[str]:
    return [str(seed) for seed in range(count)]


CAMPAIGNS = {
    "scenes": Campaign(_seeds(10_000), _scene(measure.ordinary_errors)),
    "extreme": Campaign(_seeds(200), _scene(measure.extreme_errors)),
    "gradients": Campaign(_seeds(500), _scene(measure.gradient_errors)),
    "fuzz": Campaign([f"{name}-{seed}" for seed in range(3) for name in TARGETS], fuzz_unit),
}


def rows(name: str) -> list[Row]:
    """What was measured so far; a line cut off by a kill is left out."""
    path = FOLDER / f"{name}.jsonl"
    return list(_whole(path.read_text().splitlines())) if path.is_file() else []


def _whole(lines: list[str]) -> Iterator[Row]:
    for line in lines:
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def run(name: str, seconds: float, count: int | None = None) -> bool:
    """Go on with a campaign for that long; whether it is complete."""
    campaign = CAMPAIGNS[name]
    done = {row["unit"] for row in rows(name)}
    FOLDER.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    with (FOLDER / f"{name}.jsonl").open("a") as file:
        for unit in campaign.units[:count]:
            if unit in done:
                continue
            if time.monotonic() - started > seconds:
                return False
            file.write(json.dumps({"unit": unit} | campaign.run(unit)) + "\n")
            file.flush()
    return True


def main(argv: list[str] | None = None) -> int:
    """Exit code 0 when complete, 3 when there is more to do."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=list(CAMPAIGNS))
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after the unit that passes this")
    parser.add_argument("--count", type=int, help="units, instead of all")
    arguments = parser.parse_args(argv)
    complete = run(arguments.name, arguments.seconds, arguments.count)
    print(f"{arguments.name}: {len(rows(arguments.name))} units, {'complete' if complete else 'more to do'}")
    return 0 if complete else 3


if __name__ == "__main__":
    sys.exit(main())
