"""A line chart with logarithmic axes as SVG text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

_WIDTH, _HEIGHT, _MARGIN, _LEGEND = 640, 400, 56, 150
_COLORS = ("#1b6ca8", "#d1495b", "#3f8f3f", "#e0a030", "#7a5195", "#444444")


def line_chart(lines: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str) -> str:
    """Each line is a list of (x, y), all positive."""
    points = [point for line in lines.values() for point in line]
    low_x, high_x = _range([x for x, _ in points])
    low_y, high_y = _range([y for _, y in points])

    def place(x: float, y: float) -> tuple[float, float]:
        across = (math.log(x) - low_x) / (high_x - low_x)
        up = (math.log(y) - low_y) / (high_y - low_y)
        return _MARGIN + across * (_WIDTH - _MARGIN - _LEGEND), _HEIGHT - _MARGIN - up * (_HEIGHT - 2 * _MARGIN)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}" font-family="sans-serif" '
        f'font-size="12"><rect width="100%" height="100%" fill="white"/>'
    ]
    bottom, left = _HEIGHT - _MARGIN, _MARGIN
    for x in sorted({x for x, _ in points}):
        across, _ = place(x, math.exp(low_y))
        parts.append(f'<text x="{across:.1f}" y="{bottom + 18}" text-anchor="middle">{x:g}</text>')
        parts.append(f'<path d="M{across:.1f} {bottom}V{_MARGIN}" stroke="#dddddd"/>')
    for power in range(math.floor(low_y / math.log(10)), math.ceil(high_y / math.log(10)) + 1):
        for y in (10.0**power, 3.0 * 10.0**power):
            if low_y <= math.log(y) <= high_y:
                _, up = place(math.exp(low_x), y)
                parts.append(f'<text x="{left - 6}" y="{up + 4:.1f}" text-anchor="end">{y:g}</text>')
                parts.append(f'<path d="M{left} {up:.1f}H{_WIDTH - _LEGEND}" stroke="#dddddd"/>')
    for index, (name, line) in enumerate(lines.items()):
        color = _COLORS[index % len(_COLORS)]
        placed = [place(x, y) for x, y in line]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in placed)
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in placed]
        row = _MARGIN + 18 * index
        parts.append(f'<text x="{_WIDTH - _LEGEND + 12}" y="{row}" fill="{color}">{name}</text>')
    middle = (_MARGIN + _WIDTH - _LEGEND) / 2
    parts.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 14}" text-anchor="middle">{x_label}</text>')
    parts.append(f'<text x="{left - 40}" y="{_MARGIN - 20}">{y_label}</text></svg>')
    return "\n".join(parts) + "\n"


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = math.log(min(values)), math.log(max(values))
    return (low, high) if high > low else (low - 0.5, high + 0.5)
