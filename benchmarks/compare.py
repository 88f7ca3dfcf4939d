"""What got slower or less accurate between two result files: `python -m benchmarks.compare OLD.json NEW.json`.

Reads any file that a benchmark writes. Values are matched by their place, rows of a table by their texts and counts.
A time's ratio is new over old, an error's likewise; decibels are turned into ratios of the error's size, and scores of
at most 1 into ratios of what is missing to 1. Values in files are rounded: only what that cannot explain counts.

Exit code: 0 nothing got worse, 1 something did or is gone, 2 a file cannot be read.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SLOWER, WORSE = 1.25, 1.05

# Words of names; what matches none of the lists is an error, of which less is better.
MACHINE = frozenset({"machine", "load", "floor", "torch", "memory", "fma", "gflops", "counters"})  # not ours
SETTINGS = frozenset({"views", "photos", "splats", "side", "size", "seed", "spp", "threads", "channels"}) | {
    "gaussians", "setting", "step", "threshold",
}  # fmt: skip
COUNTS = SETTINGS | {"pairs", "frames", "cores", "repeats", "sequences", "faces", "pixels", "people", "pictures"} | {
    "unmarked", "steps", "patches",
}  # fmt: skip
TIMES = frozenset({"ms", "s", "seconds", "second", "time", "times", "stages", "forward", "backward", "wall", "cpu"}) | {
    "processor", "latency", "mb", "megabytes", "gb", "mib", "gib", "milliseconds",
}  # fmt: skip
RATES = frozenset({"fps", "speedup", "ratio"})  # of speed, more is better; so is what is counted per second
PER_SECOND = re.compile(r"\bper (processor )?(s|second)\b")
GAINS = frozenset({"detected", "score"})  # more is better
SCORES = frozenset({"ssim", "iou", "correlation", "trusted", "csim"})  # at most 1, more is better
DECIBELS = frozenset({"psnr", "db"})
MEASURED = TIMES | RATES | SCORES | DECIBELS
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class Literal(str):
    """A number of a JSON file as it is written there."""


@dataclass(frozen=True)
class Value:
    """A number and half of its last digit."""

    number: float
    slack: float


@dataclass(frozen=True)
class Change:
    """One value in both files."""

    place: str
    time: bool
    old: Value
    new: Value
    ratio: float  # new over old badness, as printed
    least: float  # what of it the rounding cannot explain; 1 when it can explain all


class UnreadableError(Exception):
    """A file that holds no results; the message names it."""


def read(path: Path) -> dict[str, Value]:
    """Every measured value of a file by its place.

    Raises:
        UnreadableError: it is missing or no JSON.
    """
    try:
        content = json.loads(path.read_text(), parse_float=Literal, parse_int=Literal)
    except (OSError, ValueError) as error:
        raise UnreadableError(f"{path}: cannot be read as a benchmark's JSON file ({error})") from error
    return dict(_values(content, ""))


def compare(old: dict[str, Value], new: dict[str, Value]) -> list[Change]:
    """All values that both files have."""
    return [_change(place, old[place], new[place]) for place in old if place in new]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what changed; see the module for the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--slower", type=float, default=SLOWER, help="ratio of times from which it counts")
    parser.add_argument("--worse", type=float, default=WORSE, help="ratio of errors from which it counts")
    options = parser.parse_args(arguments)
    try:
        old, new = read(options.old), read(options.new)
    except UnreadableError as error:
        print(f"compare: {error}", file=sys.stderr)
        return 2
    changes = compare(old, new)
    if not changes:
        print(f"compare: {options.old} and {options.new} have no value in common", file=sys.stderr)
        return 2
    limit = {True: options.slower, False: options.worse}
    bad = sorted((c for c in changes if c.least > limit[c.time]), key=lambda c: -c.least)
    good = [c for c in changes if c.ratio < 1 / limit[c.time]]
    gone = [place for place in old if place not in new]
    for change in bad:
        _print("slower" if change.time else "less accurate", change)
    for change in good:
        _print("faster" if change.time else "more accurate", change)
    for place in gone:
        print(f"gone: {place}")
    print(f"{len(changes)} values: {len(bad)} worse, {len(good)} better, {len(gone)} gone")
    return int(bool(bad or gone))


def _print(word: str, change: Change) -> None:
    print(f"{word} x{change.ratio:.2f}: {change.place}: {change.old.number:g} -> {change.new.number:g}")


def _values(content: Any, place: str) -> Iterator[tuple[str, Value]]:
    if isinstance(content, dict):
        for key, value in content.items():
            name = str(key).replace("/s", " per s").replace("/", "|")
            yield from _values(value, f"{place}/{name}" if place else name)
    elif isinstance(content, list):
        for label, item in _labelled(content):
            yield from _values(item, f"{place}[{label}]")
    elif not _words(place) & MACHINE and (
        _words(own := place.rpartition("/")[2]) & MEASURED or not _words(own) & COUNTS
    ):
        parts = NUMBER.findall(content) if isinstance(content, str) and _numeric(content) else []
        for index, text in enumerate(parts):
            yield f"{place}#{index + 1}" if len(parts) > 1 else place, _value(text)


def _labelled(rows: list[Any]) -> Iterator[tuple[str, Any]]:
    """Rows with what tells them apart: their texts and counts, and their number where that is not enough."""
    seen: dict[str, int] = {}
    for row in rows:
        parts = []
        for key, value in row.items() if isinstance(row, dict) else ():
            text = isinstance(value, str) and not _numeric(value)
            if text or (isinstance(value, str) and _words(str(key)) & SETTINGS):
                parts.append(f"{key}={value}")
        label = " ".join(parts)
        seen[label] = seen.get(label, 0) + 1
        yield f"{label} #{seen[label]}".strip() if seen[label] > 1 or not label else label, row


def _numeric(text: str) -> bool:
    """Whether a text is one number or several, such as "8.3 / 16.2" or "42x"."""
    return bool(NUMBER.search(text)) and not re.sub(rf"{NUMBER.pattern}|[\s/x%]", "", text)


def _text(place: str) -> str:
    return re.sub(r"[_/|]", " ", re.sub(r"\[.*?\]|#\d+", " ", place).lower())


def _words(place: str) -> set[str]:
    return set(_text(place).split())


def _value(text: str) -> Value:
    digits, _, power = text.lower().partition("e")
    places = len(digits.partition(".")[2])
    return Value(float(text), 0.5 * 10.0 ** (int(power or 0) - places))


def _change(place: str, old: Value, new: Value) -> Change:
    words = _words(place)
    rate = bool(words & RATES or PER_SECOND.search(_text(place)))

    def badness(number: float) -> float:
        if words & DECIBELS:
            return 10 ** (-number / 20)
        if words & SCORES:
            return max(1 - number, 0.0)
        return 1 / number if (rate or words & GAINS) and number > 0 else abs(number)

    # JSON drops zeros at the end, so that the finer of the two tells how both were rounded.
    slack = min(old.slack, new.slack)
    before, after = ([badness(value.number + side * slack) for side in (-1, 1)] for value in (old, new))
    ratio = _ratio(badness(new.number), badness(old.number))
    least = max(_ratio(min(after), max(before)), 1.0)
    return Change(place, bool(words & TIMES) or rate, old, new, ratio, least)


def _ratio(new: float, old: float) -> float:
    if old == new:
        return 1.0
    return new / old if old > 0 else math.inf


if __name__ == "__main__":
    sys.exit(main())
