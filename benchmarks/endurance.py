"""Memory and compiled kernels over thousands of steps and frames with changing numbers of splats and sizes.

`python -m benchmarks.endurance [--steps 2000] [--frames 5000]`; flat lines after the first pass over the sizes are what
is wanted. With a count of 0 what was measured before is kept.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
from pathlib import Path

from benchmarks.harness import RESULTS, markdown, save
from drjit_splat import profile, rasterization
from tests.avatars import painted_avatar
from tests.drjit_splat.common import random_scene
from uika.head import load_head

TITLES = {
    "steps": "forward + backward, 100 to 3,000 splats, 3 sizes",
    "frames": "animated frames, 3 sizes",
}
SIZES = ((64, 64), (96, 64), (48, 80))


def resident() -> float:
    """MiB of memory that the process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def steps(count: int, every: int) -> list[dict[str, float]]:
    """Forward and backward passes over scenes of 100 to 3,000 splats; a row each `every` steps."""
    rng = random.Random(0)
    rows = []
    compiled = 0
    for step in range(count):
        width, height = SIZES[step % len(SIZES)]
        scene = random_scene(rng.randrange(100, 3000), width, height, seed=step)
        leaves = {name: value.requires_grad_() for name, value in scene.items()}
        with profile() as report:
            image = rasterization(**leaves, width=width, height=height)[0]
            image.square().sum().backward()
        compiled += report.compiled
        if step % every == 0 or step == count - 1:
            rows.append({"step": step + 1, "MiB": resident(), "compiled": compiled})
    return rows


def frames(count: int, every: int) -> list[dict[str, float]]:
    """Animated frames of an avatar at changing picture sizes; a row each `every` frames."""
    from uika.avatar.frame_renderer import film
    from uika.motion.presets import get_motion

    head = load_head()
    avatar = painted_avatar(head)
    rows, shown, compiled, turns = [], 0, 0, 0
    while shown < count:
        size, marks = (64, 96, 128)[turns % 3], []
        with profile() as report:
            for _ in film(avatar, get_motion("talk", head, 25.0), head=head, size=size):
                shown += 1
                if shown % every == 0 or shown == count:
                    marks.append({"step": shown, "MiB": resident()})
                if shown == count:
                    break
        compiled += report.compiled
        rows += [mark | {"compiled": compiled} for mark in marks]
        turns += 1
    return rows


def flatness(rows: list[dict[str, float]]) -> dict[str, object]:
    """Growth after the first tenth, in which kernels are compiled and pools filled."""
    warm = [row for row in rows if row["step"] >= rows[-1]["step"] / 10]
    return {
        "done": rows[-1]["step"],
        "MiB after a tenth": round(warm[0]["MiB"], 1),
        "MiB at most from then on": round(max(row["MiB"] for row in warm), 1),
        "MiB at the end": round(rows[-1]["MiB"], 1),
        "kernels compiled in the first tenth": warm[0]["compiled"],
        "kernels compiled after it": rows[-1]["compiled"] - warm[0]["compiled"],
    }


def draw(found: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Memory and compiled kernels over steps and frames."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawing, panels = pyplot.subplots(2, len(found), figsize=(5.5 * len(found), 6), dpi=100, squeeze=False)
    for column, (name, rows) in enumerate(found.items()):
        steps = [row["step"] for row in rows]
        for axes, key, label in zip(panels[:, column], ("MiB", "compiled"), ("resident MiB", "kernels"), strict=True):
            axes.plot(steps, [row[key] for row in rows], ".-")
            axes.set_ylim(0, 1.15 * max(1, max(row[key] for row in rows)))
            axes.set_xlabel(name)
            axes.set_ylabel(label)
            axes.grid(True, alpha=0.25)
        panels[0, column].set_title(TITLES[name])
    drawing.tight_layout()
    drawing.savefig(path)


def main(argv: list[str] | None = None) -> int:
    """Measure, write the rows and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--frames", type=int, default=5000)
    arguments = parser.parse_args(argv)
    measured = {"steps": (steps, arguments.steps), "frames": (frames, arguments.frames)}
    kept = RESULTS / "endurance.json"
    before = json.loads(kept.read_text()) if kept.is_file() else {}
    found = {
        name: run(count, max(1, count // 40)) if count else before[name]
        for name, (run, count) in measured.items()
        if count or name in before
    }
    table = [{"what": TITLES[name], **flatness(rows)} for name, rows in found.items()]
    draw(found, RESULTS / "endurance.png")
    text = f"{markdown(table)}\n\n![](endurance.png)"
    save("endurance", "Memory and compiled kernels over many steps and frames", text, dict(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
