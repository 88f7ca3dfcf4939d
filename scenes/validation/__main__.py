"""Splats against Mitsuba: `python -m scenes.validate -o report/` compares poses, views and gradients."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scenes.validation.gradients import GradientReport, compare_gradients
from scenes.validation.report import write_report
from scenes.validation.views import (
    AT_LEAST,
    BUST_VIEW,
    HEAD_VIEW,
    LIMITS,
    POSES,
    SIZE,
    VIEWS,
    Pictures,
    ViewReport,
    compare_view,
    poses,
)
from uika.head import HeadModel, load_head, look_at


def validate(
    head: HeadModel, pose_count: int = POSES, views: Sequence[tuple[float, float]] = VIEWS
) -> tuple[list[ViewReport], GradientReport, Pictures]:
    """Compare views and gradients of one head model; the pictures show splats, Mitsuba and their difference."""
    reports, pictures = [], []
    params = poses(head, pose_count)
    distance, target = HEAD_VIEW if head.bust is None else BUST_VIEW
    for pose in range(pose_count):
        for view, (yaw, pitch) in enumerate(views):
            camera = look_at(yaw, pitch, distance, target, size=SIZE)
            report, picture = compare_view(head, params[pose], camera, pose, view)
            reports.append(report)
            pictures.append((f"{head.id}: pose {pose}, view {view}", picture))
    return reports, compare_gradients(head), pictures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the validation; 0 when every figure is within its limits, 1 otherwise."""
    parser = argparse.ArgumentParser(prog="python -m scenes.validate", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the report")
    parser.add_argument("--head", type=Path, action="append", default=[], help="another head file to compare as well")
    parser.add_argument("--quick", action="store_true", help="two poses instead of twelve")
    options = parser.parse_args(arguments)
    heads = [load_head().without_bust, load_head(), *(load_head(path) for path in options.head)]
    results = [validate(head, 2 if options.quick else POSES) for head in heads]
    passed = write_report(options.output, results)
    for reports, gradients, _ in results:
        for name in LIMITS:
            values = [getattr(report, name) for report in reports]
            median, worst = np.median(values), _worst(name, values)
            print(f"{reports[0].head} {name}: median {median:.4g}, worst {worst:.4g}")
        print(f"{reports[0].head} gradients: cosine {gradients.cosine:.4f}, ratios {gradients.ratios}")
    print("passed" if passed else "failed", options.output / "index.html")
    return 0 if passed else 1


def _worst(name: str, values: list[float]) -> float:
    return min(values) if name in AT_LEAST else max(values)


if __name__ == "__main__":
    sys.exit(main())
