"""Memory and compiled kernels over thousands of steps and frames with changing numbers of splats and sizes.

`python -m benchmarks.endurance [--steps 2000] [--frames 5000]` writes out/endurance.json; flat numbers after the first
pass over the sizes are what is wanted.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
from pathlib import Path

import drjit as dr
import torch

from drjit_splat import profile, rasterization
from tests.avatars import painted_avatar
from tests.drjit_splat.common import random_scene
from uika.head import load_head

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
            rows.append({"step": step, "MiB": resident(), "compiled": compiled})
    return rows


def frames(count: int, every: int) -> list[dict[str, float]]:
    """Animated frames of an avatar at changing picture sizes; a row each `every` frames."""
    from uika.acting import get_motion
    from uika.filming import film

    head = load_head()
    avatar = painted_avatar(head)
    rows, shown, compiled = [], 0, 0
    while shown < count:
        size, marks = (64, 96, 128)[len(rows) % 3], []
        with profile() as report:
            for _ in film(avatar, get_motion("talk", head, 25.0), head=head, size=size):
                shown += 1
                if shown % every == 0 or shown == count:
                    marks.append({"step": shown, "MiB": resident()})
                if shown == count:
                    break
        compiled += report.compiled
        rows += [mark | {"compiled": compiled} for mark in marks]
    return rows


def main(argv: list[str] | None = None) -> int:
    """Measure, write the rows and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("-o", "--output", type=Path, default=Path("out"))
    arguments = parser.parse_args(argv)
    torch.manual_seed(0)
    found = {
        "steps": steps(arguments.steps, max(1, arguments.steps // 40)),
        "frames": frames(arguments.frames, max(1, arguments.frames // 40)) if arguments.frames else [],
        "threads": dr.thread_count(),
    }
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "endurance.json").write_text(json.dumps(found, indent=1))
    for name in ("steps", "frames"):
        for row in found[name]:
            print(f"{name} {row['step']:6d}  {row['MiB']:8.1f} MiB  {row['compiled']} kernels compiled")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
