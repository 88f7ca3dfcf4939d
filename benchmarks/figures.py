"""Figures of the benchmarks: bars and lines in a row of panels, saved beside the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from benchmarks.harness import RESULTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Line = Sequence[tuple[float, float]]


def bars(name: str, panels: Mapping[str, Mapping[str, Mapping[str, float]]], unit: str, log: bool = False) -> None:
    """Write results/<name>.png: a panel for each title, a group of bars for each label, a colour for each series.

    Args:
        name: of the file.
        panels: title -> series -> label -> value; what a series lacks stays empty.
        unit: below every panel.
        log: whether the values' axis is logarithmic.
    """
    most = max(
        len({label for series in groups.values() for label in series}) * (1 + len(groups)) for groups in panels.values()
    )
    drawing = _figure(len(panels), 1.3 + 0.13 * most)
    for place, (title, groups) in enumerate(panels.items(), 1):
        axes = drawing.add_subplot(1, len(panels), place)
        labels = list(dict.fromkeys(label for series in groups.values() for label in series))
        height = 0.8 / len(groups)
        for index, (series, values) in enumerate(groups.items()):
            shown = [(row + height * index, values[label]) for row, label in enumerate(labels) if label in values]
            axes.barh([y for y, _ in shown], [v for _, v in shown], height, label=series)
        axes.set_yticks([row + height * (len(groups) - 1) / 2 for row in range(len(labels))], labels, fontsize=8)
        axes.invert_yaxis()
        axes.set_xscale("log" if log else "linear")
        axes.set(title=title, xlabel=unit)
        axes.grid(True, axis="x", alpha=0.25)
        if len(groups) > 1:
            axes.legend(fontsize=8)
    drawing.savefig(RESULTS / f"{name}.png")


def lines(name: str, panels: Mapping[tuple[str, str], Mapping[str, Line]], log: str = "xy") -> None:
    """Write results/<name>.png: a panel for each pair of axis labels, with a line for each series of (x, y).

    Args:
        name: of the file.
        panels: (x label, y label) -> series -> points.
        log: the axes that are logarithmic: "", "x", "y" or "xy".
    """
    drawing = _figure(len(panels), 3.6)
    for place, ((x_label, y_label), series) in enumerate(panels.items(), 1):
        axes = drawing.add_subplot(1, len(panels), place)
        for label, points in series.items():
            axes.plot([x for x, _ in points], [y for _, y in points], marker="o", markersize=4, label=label)
        axes.set_xscale("log" if "x" in log else "linear")
        axes.set_yscale("log" if "y" in log else "linear")
        axes.set(xlabel=x_label, ylabel=y_label)
        axes.grid(True, which="both", alpha=0.25)
        if len(series) > 1:
            axes.legend(fontsize=8)
    drawing.savefig(RESULTS / f"{name}.png")


def _figure(panels: int, height: float) -> Figure:
    from matplotlib.figure import Figure

    RESULTS.mkdir(parents=True, exist_ok=True)
    return Figure(figsize=(5.2 * panels, height), dpi=100, layout="constrained")
