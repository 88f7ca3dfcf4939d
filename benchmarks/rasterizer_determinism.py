"""Repeatability and endurance: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_determinism`.

Images between runs and thread counts, the spread of gradients, kernels compiled while the number of splats changes at
every step, resident memory over many steps, and the training loop of the fitting example.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import torch

from benchmarks.figures import bars
from benchmarks.harness import markdown, save
from benchmarks.splat_scenes import Scene, head_scene
from drjit_splat import profile, rasterization
from examples import fit_image_torch
from uika.assets import PORTRAIT


def step(scene: Scene, weight: torch.Tensor, count: int | None = None) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Image and gradients of the first `count` splats."""
    leaves = [t[:count].detach().requires_grad_() for t in scene.tensors[:5]]
    image = rasterization(*leaves, *scene.tensors[5:], scene.size, scene.size)[0][0]
    return image.detach(), list(torch.autograd.grad(image, leaves, grad_outputs=weight))


def spread(a: list[torch.Tensor], b: list[torch.Tensor]) -> float:
    """Largest relative L2 difference over the tensors."""
    return max(float((x - y).norm() / y.norm()) for x, y in zip(a, b, strict=True))


def resident() -> float:
    """MB of memory in use by this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def repeatability(scene: Scene, weight: torch.Tensor) -> list[dict[str, object]]:
    """Images and gradients over runs and thread counts."""
    threads = dr.thread_count()
    first_image, first = step(scene, weight)
    rows: list[dict[str, object]] = []
    for count, label in ((threads, "same threads"), (1, "1 thread"), (1, "1 thread again"), (2, "2 threads")):
        dr.set_thread_count(count)
        image, gradients = step(scene, weight)
        rows.append(
            {
                "against the first run": label,
                "image bit-equal": bool(torch.equal(image, first_image)),
                "gradient spread": f"{spread(gradients, first):.1e}",
            }
        )
        if label == "1 thread":
            one = gradients
        if label == "1 thread again":
            rows[-1]["against the first run"] = "1 thread, between two runs"
            rows[-1]["gradient spread"] = f"{spread(gradients, one):.1e}"
    dr.set_thread_count(threads)
    return rows


def endurance(scene: Scene, weight: torch.Tensor, changing: int, steps: int) -> dict[str, object]:
    """Kernels and memory while the number of splats changes, then over many equal steps."""
    n = len(scene.means)
    generator = torch.Generator().manual_seed(4)
    with profile() as warm:
        for count in (n, n // 2 + 1, n - 1):
            step(scene, weight, count)
    counts = torch.randint(n // 2, n, (changing,), generator=generator).tolist()
    with profile() as report:
        for count in counts:
            step(scene, weight, count)
    for _ in range(20):
        step(scene, weight)
    before, start = resident(), time.perf_counter()
    highest = before
    for k in range(steps):
        step(scene, weight, counts[k % len(counts)])
        if k % 50 == 0:
            highest = max(highest, resident())
    spent = time.perf_counter() - start
    return {
        "kernels compiled while warming up": warm.compiled,
        f"kernels compiled in {changing} steps of other sizes": report.compiled,
        "kernels a step": round(report.launched / changing, 1),
        f"MB before {steps} steps": round(before),
        "MB at most": round(highest),
        "MB after": round(resident()),
        "ms a step": round(1e3 * spent / steps, 1),
    }


def example(steps: int) -> dict[str, object]:
    """The fitting example: 4000 splats on 256 x 256 pixels with Adam."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            fit_image_torch.fit(PORTRAIT, steps=10, report=0)
            start = time.perf_counter()
            errors = fit_image_torch.fit(PORTRAIT, steps=steps, report=0)
            spent = time.perf_counter() - start
        finally:
            os.chdir(here)
    return {"steps": steps, "ms a step": round(1e3 * spent / steps, 1), "last error": f"{errors[-1]:.5f}"}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--changing", type=int, default=200)
    parser.add_argument("--quick", action="store_true", help="small scenes and few steps")
    arguments = parser.parse_args(argv)
    if arguments.quick:
        arguments.steps, arguments.changing = 40, 10
    large, small = head_scene(*((3_000, 96) if arguments.quick else (130_000, 512))), head_scene(10_000, 128)
    weights = [torch.rand(s.size, s.size, 3, generator=torch.Generator().manual_seed(1)) for s in (large, small)]
    rows = repeatability(large, weights[0])
    lasting = endurance(small, weights[1], arguments.changing, arguments.steps)
    fitted = example(10 if arguments.quick else 100)
    text = "\n\n".join(
        (
            f"{len(large.means)} @ {large.size} x {large.size}, image and gradients against a first run:",
            markdown(rows),
            "Up to 10k @ 128 x 128:",
            markdown([lasting]),
            "The fitting example (4000 splats, 256 x 256, torch's Adam):",
            markdown([fitted]),
        )
    )
    save(
        "rasterizer_determinism",
        "Rasterizer: repeatability",
        text,
        {"runs": rows, "lasting": lasting, "example": fitted},
    )
    spreads = {str(row["against the first run"]): float(str(row["gradient spread"])) for row in rows}
    memory = {name: float(str(value)) for name, value in lasting.items() if name.startswith("MB")}
    bars("rasterizer_determinism", {"spread of gradients": {"": spreads}, "memory, MB": {"": memory}}, "")


if __name__ == "__main__":
    main()
