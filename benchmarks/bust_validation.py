"""Splats against Mitsuba for heads with a bust, the built-in one and one in FLAME's format.

`python -m benchmarks.bust_validation`; the second head is made from the built-in one by `tests/flame_files.py` and gets
its bust as every imported head does.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.harness import markdown, save
from benchmarks.scene_validation import flame_head
from scenes.validation.__main__ import validate
from scenes.validation.views import AT_LEAST, BUST_LIMITS, VIEWS
from uika.head import load_head


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=4)
    parser.add_argument("--views", type=int, default=len(VIEWS))
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        heads = {"built-in bust": load_head(), "FLAME-format head with it": flame_head(Path(folder))}
        found = {title: validate(head, arguments.poses, VIEWS[: arguments.views])[0] for title, head in heads.items()}
    rows: list[dict[str, object]] = []
    for name, limit in BUST_LIMITS.items():
        row: dict[str, object] = {"figure": name}
        for title, reports in found.items():
            values = [getattr(report, name) for report in reports]
            worst = min(values) if name in AT_LEAST else max(values)
            row[f"{title}: median"], row[f"{title}: worst"] = f"{np.median(values):.4g}", f"{worst:.4g}"
        rows.append({**row, "limit": f"{'at least' if name in AT_LEAST else 'at most'} {limit:g}"})
    text = f"{arguments.poses} poses of different people, {arguments.views} cameras.\n\n{markdown(rows)}"
    save("bust_validation", "Busts as splats against Mitsuba", text, {"rows": rows})


if __name__ == "__main__":
    main()
