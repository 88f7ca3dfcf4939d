"""Time the rasterizer on head-like scenes: python benchmarks/rasterizer_speed.py [--repeats 15]."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from splat_scenes import Scene, head_scene

from drjit_splat import rasterization

SIZES = ((30_000, 256), (130_000, 512), (500_000, 1024))


def timed(function: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Minimum and median milliseconds after three warm-up calls."""
    for _ in range(3):
        function()
    spans = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        spans.append(1e3 * (time.perf_counter() - start))
    return min(spans), statistics.median(spans)


def measure(scene: Scene, repeats: int) -> tuple[tuple[float, float], tuple[float, float], int]:
    """Forward, forward + backward, and the number of (tile, splat) pairs."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]
    target = torch.rand(1, scene.size, scene.size, 3, generator=torch.Generator().manual_seed(1))

    def forward() -> int:
        with torch.no_grad():
            meta = rasterization(*scene.tensors, scene.size, scene.size)[2]
        return int(meta["n_pairs"][0])

    def both() -> None:
        image = rasterization(*leaves, *scene.tensors[5:], scene.size, scene.size)[0]
        torch.autograd.grad(image, leaves, grad_outputs=target)

    pairs = forward()
    return timed(forward, repeats), timed(both, repeats), pairs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--sizes", type=int, default=2, help="how many of the three scenes to run")
    arguments = parser.parse_args()
    print("| splats | image | forward min / median ms | forward + backward min / median ms | pairs |")
    print("|---|---|---|---|---|")
    for count, size in SIZES[: arguments.sizes]:
        forward, both, pairs = measure(head_scene(count, size), arguments.repeats)
        cells = (
            f"{count}",
            f"{size}²",
            "{:.1f} / {:.1f}".format(*forward),
            "{:.1f} / {:.1f}".format(*both),
            f"{pairs}",
        )
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
