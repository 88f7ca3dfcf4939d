"""Results gathered into the rows of tables."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uika.evaluate.protocol import METRICS, Metric, Protocol
from uika.evaluate.score import mean
from uika.evaluate.store import PROTOCOL, RESULTS, Result, read_protocol, read_result
from uika.io.files import replacing

ABSENT = "-"


@dataclass(frozen=True)
class Row:
    """A method with a number of views."""

    protocol: Protocol
    views: int
    results: tuple[Result, ...]

    @property
    def counts(self) -> tuple[str, ...]:
        """Method, views, sequences, frames and frames with a face in both pictures."""
        frames = sum(len(result.targets) for result in self.results)
        faces = sum(result.faces for result in self.results)
        return self.protocol.method, str(self.views), str(len(self.results)), str(frames), f"{faces}/{frames}"

    def value(self, metric: Metric) -> float | None:
        """The mean over sequences of the mean over frames."""
        return mean([mean(result.scores[metric.name]) for result in self.results])

    def cell(self, metric: Metric) -> str:
        """The value as text, or which file it needs."""
        return cell(self.protocol, metric, self.value(metric))


@dataclass(frozen=True)
class Section:
    """All methods in one setting and task; one table."""

    setting: str
    task: str
    rows: tuple[Row, ...]

    @property
    def title(self) -> str:
        """As a heading."""
        return f"{self.task.capitalize()} reenactment, {'one camera' if self.setting == 'mono' else 'several cameras'}"

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The columns."""
        return self.rows[0].protocol.metrics

    def best(self, metric: Metric, views: int) -> str | None:
        """The best cell among the methods with this number of views; None when there is no choice."""
        rows = [row for row in self.rows if row.views == views and row.value(metric) is not None]
        if len(rows) < 2:
            return None
        pick = max if metric.higher else min
        return pick(rows, key=lambda row: row.value(metric) or 0.0).cell(metric)


HEADINGS = ("method", "views", "sequences", "frames", "faces")


def heading(metric: Metric) -> str:
    """The name with the direction in which it is better."""
    return f"{metric.name} {'↑' if metric.higher else '↓'}"


def cell(protocol: Protocol, metric: Metric, value: float | None) -> str:
    """A value as text."""
    if not protocol.available(metric):
        return f"n/a: needs --{metric.needs} FILE"
    return ABSENT if value is None else f"{value:.{metric.digits}f}"


def gather(report: Path) -> list[Section]:
    """All complete results in a report's folder.

    Raises:
        UikaError: the description of a section is damaged.
    """
    found: dict[tuple[str, str], list[Row]] = {}
    for file in sorted((report / RESULTS).glob(f"*/*/{PROTOCOL}")):
        protocol = read_protocol(file)
        results = [read_result(path, protocol) for path in sorted(file.parent.glob("[!.]*.result.json"))]
        whole = [result for result in results if result is not None]
        for views in sorted({result.views for result in whole}):
            row = Row(protocol, views, tuple(result for result in whole if result.views == views))
            found.setdefault((protocol.setting, protocol.task), []).append(row)
    order = sorted(found, key=lambda key: (key[0] != "mono", key[1] != "self"))
    return [Section(*key, tuple(sorted(found[key], key=lambda row: (row.views, row.protocol.method)))) for key in order]


def write_sequences(path: Path, sections: Sequence[Section]) -> None:
    """Write a CSV file with one line for each sequence, method and number of views."""
    names = [metric.name for metric in METRICS]
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        first = ["setting", "task", "method", "views", "sequence", "driver", "frames", "faces", "seconds"]
        writer.writerow(first + names)
        for section in sections:
            for row in section.rows:
                for result in row.results:
                    lead = [section.setting, section.task, row.protocol.method, row.views, result.sequence]
                    lead += [result.driver, len(result.targets), result.faces, result.seconds]
                    writer.writerow(lead + [_number(row.protocol, metric.name, result) for metric in METRICS])


def _number(protocol: Protocol, name: str, result: Result) -> str:
    metric = next((metric for metric in protocol.metrics if metric.name == name), None)
    if metric is None:
        return ""
    if not protocol.available(metric):
        return cell(protocol, metric, None)
    value = mean(result.scores[name])
    return "" if value is None else f"{value:.6g}"
