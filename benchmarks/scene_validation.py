"""Splats against Mitsuba for the built-in head and one in FLAME's format: `python -m benchmarks.scene_validation`.

The second head is made from the built-in one by `tests/flame_files.py`. The report's page, with every picture, goes to
the folder given with `--report`.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import figures
from benchmarks.harness import markdown, save
from scenes.validation.__main__ import validate
from scenes.validation.report import write_report
from scenes.validation.views import AT_LEAST, LIMITS, POSES, VIEWS
from tests.flame_files import flame_arrays, write_obj, write_pickle
from uika.head import HeadModel, load_head
from uika.head_import import import_flame


def flame_head(folder: Path) -> HeadModel:
    """The built-in head as a FLAME model file, imported again."""
    arrays = flame_arrays()
    path, obj = write_pickle(folder / "model.pkl", arrays), write_obj(folder / "head.obj", arrays)
    return import_flame(path, folder / "head.npz", obj)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=POSES)
    parser.add_argument("--views", type=int, default=len(VIEWS))
    parser.add_argument("--report", type=Path, help="folder for the page with the pictures")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        heads = {"built-in head": load_head().without_bust, "FLAME-format head": flame_head(Path(folder)).without_bust}
        found = {title: validate(head, arguments.poses, VIEWS[: arguments.views]) for title, head in heads.items()}
    if arguments.report:
        write_report(arguments.report, list(found.values()))
    rows: list[dict[str, object]] = []
    panels: dict[str, dict[str, dict[str, float]]] = {}
    for name in LIMITS:
        row: dict[str, object] = {"figure": name}
        for title, (reports, _, _) in found.items():
            values = [getattr(report, name) for report in reports]
            worst = min(values) if name in AT_LEAST else max(values)
            row[f"{title}: median"], row[f"{title}: worst"] = f"{np.median(values):.4g}", f"{worst:.4g}"
            limit = LIMITS[name]
            share = limit / worst if name in AT_LEAST else worst / limit
            panels.setdefault("worst view, share of the limit", {}).setdefault(title, {})[name] = float(share)
        rows.append({**row, "limit": f"{'at least' if name in AT_LEAST else 'at most'} {LIMITS[name]:g}"})
    gradients = [
        {"head": title, "cosine": f"{each.cosine:.4f}", "splats / Mitsuba by yaw, jaw, expression": each.ratios}
        for title, (_, each, _) in found.items()
    ]
    text = (
        f"{arguments.poses} poses of different people, {arguments.views} cameras.\n\n{markdown(rows)}\n\n"
        "Derivatives of an image loss, against finite differences of Mitsuba's renders. Both renderers show the same "
        "picture; they differ along outlines and by a slight blur of the texture, which makes the splats' derivatives "
        f"smaller.\n\n{markdown(gradients)}"
    )
    save("scene_validation", "Splats against Mitsuba", text, {"rows": rows, "gradients": gradients})
    figures.bars("scene_validation", panels, "1 is the limit")


if __name__ == "__main__":
    main()
