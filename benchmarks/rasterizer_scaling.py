"""How run time grows: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_scaling`.

Forward and forward + backward against the number of splats (512 x 512), the side of the image (130k splats), channels
and threads; pairs worked on, bytes that the kernels move at least, and the share of the floor that arithmetic sets.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import torch

from benchmarks.harness import RESULTS, fastest_fma, interleaved, markdown, save
from benchmarks.rasterizer_table import BACKWARD_FLOP, FORWARD_FLOP
from benchmarks.splat_scenes import Scene, head_scene, passes
from drjit_splat import rasterization

COUNTS = (1_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
SIDES = (128, 256, 512, 1024, 2048)
CHANNELS = (1, 3, 4, 8, 16, 32)
# A splat: 14 numbers read, a record of 16 and a footprint of 8 written, both read again; a pair: tile, splat, sorted
# place and id written and read (8 numbers), a record gathered; a pixel: 4 numbers written.
SPLAT_BYTES, PAIR_BYTES, PIXEL_BYTES = 4 * (14 + 2 * 24), 4 * 8 + 64, 16


def coloured(scene: Scene, channels: int) -> Scene:
    """The scene with another number of channels."""
    generator = torch.Generator().manual_seed(5)
    return replace(scene, colors=torch.rand(len(scene.means), channels, generator=generator))


def measure(label: str, value: int, scene: Scene, repeats: int, peak: float) -> dict[str, object]:
    """One row."""
    functions = passes(scene)
    times = interleaved(functions, dict.fromkeys(functions, repeats))
    with torch.no_grad():
        meta = rasterization(*scene.tensors, scene.size, scene.size)[2]
    pairs = meta["n_pairs"][0]
    worked = pairs - meta["n_culled"][0]["occluded_pairs"]
    floor = worked * (FORWARD_FLOP + BACKWARD_FLOP) / peak / 1e6
    moved = len(scene.means) * SPLAT_BYTES + pairs * PAIR_BYTES + scene.size**2 * PIXEL_BYTES
    row: dict[str, object] = {
        label: value,
        "forward ms": f"{times['forward'].best:.1f}",
        "f + b ms": f"{times['both'].best:.1f}",
        "pairs": worked,
        "forward MB": f"{moved / 1e6:.0f}",
        "floor / f + b": f"{floor / times['both'].best:.0%}",
    }
    print(row, flush=True)
    return row


def figure(groups: dict[str, list[dict[str, object]]]) -> None:
    """One panel a sweep."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawing, panels = pyplot.subplots(1, len(groups), figsize=(4 * len(groups), 3.6), dpi=110)
    for axes, (label, rows) in zip(panels, groups.items(), strict=True):
        x = [float(str(row[label])) for row in rows]
        for name in ("forward ms", "f + b ms"):
            axes.plot(x, [float(str(row[name])) for row in rows], marker="o", label=name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(label)
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(fontsize=8)
    drawing.tight_layout()
    drawing.savefig(RESULTS / "rasterizer_scaling.png")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--quick", action="store_true", help="the two smallest of every sweep, once each")
    arguments = parser.parse_args(argv)
    repeats, take = (1, 2) if arguments.quick else (arguments.repeats, None)
    middle = head_scene(10_000, 128) if arguments.quick else head_scene(130_000, 512)
    peak = fastest_fma()
    groups: dict[str, list[dict[str, object]]] = {}
    groups["splats"] = [measure("splats", n, head_scene(n, 512), repeats, peak) for n in COUNTS[:take]]
    count = len(middle.means)
    groups["side"] = [measure("side", side, head_scene(count, side), repeats, peak) for side in SIDES[:take]]
    groups["channels"] = [measure("channels", d, coloured(middle, d), repeats, peak) for d in CHANNELS[:take]]
    before, threads = dr.thread_count(), []
    for n in sorted({1, 2, os.cpu_count() or 1}):
        dr.set_thread_count(n)
        threads.append(measure("threads", n, middle, repeats, peak))
    dr.set_thread_count(before)
    groups["threads"] = threads
    text = "\n\n".join(markdown(rows) for rows in groups.values())
    notes = "Least milliseconds; floor: multiply-adds of the pairs worked on at the measured rate of all threads."
    save("rasterizer_scaling", "Rasterizer: scaling", f"{notes}\n\n{text}\n\n![](rasterizer_scaling.png)", groups)
    figure(groups)


if __name__ == "__main__":
    main()
