"""Frames a second of a moving avatar by picture size and number of Gaussians, and where a frame's time goes.

Run `python -m benchmarks.animation`; writes `benchmarks/results/animation.{json,md,png}`. The video encoder
is left out.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from benchmarks.harness import RESULTS, interleaved, machine, markdown, save
from drjit_splat.profiling import profile
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.frame_renderer import FrameRenderer, film
from uika.avatar.framing import motion_cameras
from uika.avatar.rendering import frames
from uika.head import HeadModel, load_head
from uika.io.video import to_bytes
from uika.motion import Motion
from uika.motion.presets import get_motion
from uika.reconstruction import reconstruct

SIZES = (256, 512, 1024)
THINNING = (1, 2, 4, 8)
STAGES = ("meshes", "pose", "project", "sort", "emit", "bin", "lists", "blend")


def thinned(avatar: Avatar, step: int) -> Avatar:
    """Every `step`-th Gaussian, each as much larger as there are fewer."""
    names = ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric")
    kept: dict[str, Any] = {name: getattr(avatar, name)[::step].contiguous() for name in names}
    return replace(avatar, **{**kept, "scales": kept["scales"] * step**0.5})


def pace(avatar: Avatar, motion: Motion, head: HeadModel, size: int, count: int) -> dict[str, object]:
    """Milliseconds between the pictures that `film` hands out."""
    spans = []
    start = time.perf_counter()
    for _ in islice(film(avatar, motion, head=head, size=size), count):
        now = time.perf_counter()
        spans.append(1e3 * (now - start))
        start = now
    steady = spans[
        5:-1
    ]  # before: compiling and filling the line; the last was blended while the one before it was taken
    median = statistics.median(steady)
    return {
        "Gaussians": len(avatar),
        "size": size,
        "ms least": round(min(steady), 1),
        "ms median": round(median, 1),
        "frames/s": round(1e3 / median),
    }


def split(avatar: Avatar, motion: Motion, head: HeadModel, size: int, count: int) -> dict[str, object]:
    """Least milliseconds of each stage, each waited for before the next begins."""
    import drjit as dr

    renderer = FrameRenderer(avatar, head)
    cameras = motion_cameras(avatar, motion, size)
    params = motion.parameters(avatar.identity)
    found: dict[str, list[float]] = {}
    picture = None
    for first in range(0, count, 16):
        start = time.perf_counter()
        meshes = renderer.meshes(params[first : first + 16])
        found.setdefault("meshes", []).append(1e3 * (time.perf_counter() - start) / len(meshes))
        for mesh, camera in zip(meshes, cameras[first : first + 16].viewmat, strict=True):
            view = replace(cameras[first], viewmat=camera)
            dr.sync_thread()
            start = time.perf_counter()
            renderer.gaussians(mesh)
            dr.sync_thread()
            found.setdefault("pose", []).append(1e3 * (time.perf_counter() - start))
            with profile() as report:
                start = time.perf_counter()
                picture = renderer.blend(renderer.project(mesh, view), picture)
                dr.sync_thread()
                found.setdefault("frame", []).append(1e3 * (time.perf_counter() - start))
            for name, spent in report.stages.items():
                found.setdefault(name, []).append(spent)
    least = {name: min(values) for name, values in found.items()}
    row: dict[str, object] = {"Gaussians": len(avatar), "size": size}
    row |= {name: round(least[name], 2) for name in STAGES}
    return row | {"sum": round(sum(least[name] for name in STAGES), 2)}


def both_ways(avatar: Avatar, motion: Motion, head: HeadModel, count: int) -> list[dict[str, object]]:
    """The kernels beside the differentiable way through torch, one frame of 512 x 512 each in turn."""
    slow = (to_bytes(frame.rgb) for frame in frames(avatar, motion, head=head))
    fast = film(avatar, motion, head=head)
    found = interleaved({"torch posing (`frames`)": slow.__next__, "kernels (`film`)": fast.__next__}, dict.fromkeys(
        ("torch posing (`frames`)", "kernels (`film`)"), count - 4), warm=3)  # fmt: skip
    return [
        {"way": name, "ms least": round(timing.best, 1), "ms median": round(timing.median, 1)}
        for name, timing in found.items()
    ]


def draw(rows: Sequence[dict[str, Any]], stages: Sequence[dict[str, Any]]) -> None:
    """Frames a second against Gaussians, a line a size, and the stages as bars."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 4.2), layout="constrained")
    speed, bars = drawing.subplots(1, 2)
    for size in sorted({row["size"] for row in rows}):
        line = sorted((row["Gaussians"], row["frames/s"]) for row in rows if row["size"] == size)
        speed.loglog([x for x, _ in line], [y for _, y in line], marker="o", label=f"{size} x {size}")
    counts = sorted({row["Gaussians"] for row in rows})
    speed.set_xticks(counts, [f"{count:,}" for count in counts], minor=False)
    speed.set_xticks([], minor=True)
    rates = (5, 10, 20, 40, 60, 100, 200)
    speed.set_yticks(rates, [str(rate) for rate in rates], minor=False)
    speed.set_yticks([], minor=True)
    speed.axhline(60, color="grey", linestyle=":", linewidth=1)
    speed.set(xlabel="Gaussians", ylabel="frames a second")
    speed.legend()
    names = [f"{row['size']}" for row in stages]
    below = [0.0] * len(stages)
    for name in STAGES:
        heights = [row[name] for row in stages]
        bars.bar(names, heights, bottom=below, label=name)
        below = [a + b for a, b in zip(below, heights, strict=True)]
    bars.axhline(1e3 / 60, color="grey", linestyle=":", linewidth=1)
    bars.set(xlabel="side of the picture, pixels", ylabel="ms a frame, stages one after another")
    bars.legend(fontsize=8)
    drawing.savefig(RESULTS / "animation.png")


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--avatar", type=Path, help="an avatar file; by default one made from the bundled portrait")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--quick", action="store_true", help="two sizes, two counts and few frames")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(2)
    head = load_head()
    avatar = Avatar.load(arguments.avatar) if arguments.avatar else reconstruct([PORTRAIT], head).avatar
    motion = get_motion("talk", head)
    count = min(24 if arguments.quick else arguments.frames, len(motion))
    sizes, steps = (SIZES[:2], THINNING[::3]) if arguments.quick else (SIZES, THINNING)
    rows = [pace(thinned(avatar, step), motion, head, size, count) for size in sizes for step in steps]
    stages = [split(avatar, motion, head, size, count) for size in sizes]
    ways = both_ways(avatar, motion, head, min(count, 40))
    facts = machine()
    RESULTS.mkdir(parents=True, exist_ok=True)
    draw(rows, stages)
    text = (
        f"{facts['processor']}, {facts['cores']} cores, load {facts['load'][0]} at the end: what exceeds the number\n"
        "of cores is other work that took processor time and memory bandwidth meanwhile. Pictures of the talking\n"
        "default avatar as bytes, without the video encoder; frames/s are those of the median frame.\n\n"
        f"{markdown(rows)}\n\nStages of the whole avatar, least milliseconds, each waited for alone (in a film they\n"
        f"overlap with Python's part of the next frame):\n\n{markdown(stages)}\n\n"
        f"At 512 x 512, beside the differentiable way:\n\n{markdown(ways)}\n\n![](animation.png)"
    )
    save("animation", "Animation", text, {"machine": facts, "speed": rows, "stages": stages, "ways": ways})


if __name__ == "__main__":
    main()
