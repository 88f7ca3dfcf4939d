"""The validation's result as one HTML page with pictures."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scenes.colour import linear_to_srgb
from scenes.exr import write_png
from scenes.validation.gradients import NAMES, GradientReport
from scenes.validation.views import LIMITS, Pictures, ViewReport
from uika.io.files import replacing

Result = tuple[list[ViewReport], GradientReport, Pictures]
_STYLE = (
    "body{font:15px sans-serif;margin:2em}td,th{padding:2px 10px;text-align:right}.bad{background:#fbb}img{width:720px}"
)


def write_report(folder: Path, results: Sequence[Result]) -> bool:
    """Write `index.html` and its pictures; return whether everything is within its limits."""
    folder.mkdir(parents=True, exist_ok=True)
    parts, passed = [], True
    for number, (reports, gradients, pictures) in enumerate(results):
        passed = passed and gradients.passed() and not any(report.failures() for report in reports)
        parts.append(
            f"<h2>{html.escape(reports[0].head)}</h2>{_summary(reports)}{_gradients(gradients)}{_views(reports)}"
        )
        for index, (caption, picture) in enumerate(pictures):
            name = f"view_{number}_{index:02d}.png"
            write_png(folder / name, linear_to_srgb(picture))
            parts.append(f"<p>{html.escape(caption)} (splats, Mitsuba, difference)<br><img src='{name}'></p>")
    verdict = "passed" if passed else "failed"
    body = f"<h1>Splats against Mitsuba: {verdict}</h1>" + "".join(parts)
    with replacing(folder / "index.html") as temporary:
        temporary.write_text(
            f"<!doctype html><meta charset='utf-8'><title>{verdict}</title><style>{_STYLE}</style>{body}"
        )
    return passed


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(row) + "</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def _cell(value: float, bad: bool = False) -> str:
    return f"<td{' class=bad' if bad else ''}>{value:.4g}</td>"


def _summary(reports: list[ViewReport]) -> str:
    rows = []
    for name, limit in reports[0].limits.items():
        values = np.array([getattr(report, name) for report in reports])
        rows.append(
            [f"<td>{name}</td>", *(_cell(float(v)) for v in (np.median(values), values.min(), values.max(), limit))]
        )
    return _table(("figure", "median", "lowest", "highest", "limit"), rows)


def _gradients(gradients: GradientReport) -> str:
    rows = [
        [f"<td>{name}</td>", *map(_cell, values)]
        for name, *values in zip(NAMES, gradients.splats, gradients.mitsuba, gradients.ratios, strict=True)
    ]
    title = f"<p>Gradients: cosine {gradients.cosine:.4f}, {'passed' if gradients.passed() else 'failed'}</p>"
    return title + _table(("derivative by", "splats", "Mitsuba, differences", "ratio"), rows)


def _views(reports: list[ViewReport]) -> str:
    names = ["pose", "view", *LIMITS]
    rows = [[_cell(getattr(report, name), name in report.failures()) for name in names] for report in reports]
    return _table(names, rows)
