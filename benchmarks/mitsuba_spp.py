"""Samples per pixel, time and error of the reference renders against a converged one; memory over many renders.

Run `python -m benchmarks.mitsuba_spp` (minutes; `--reference 256 --renders 50` for a quick look); writes
`benchmarks/results/mitsuba_spp.{json,md,png}`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import scenes
from benchmarks.figures import lines
from benchmarks.harness import markdown, save
from scenes.people import paint, sample_person
from scenes.people.hair import hair_offsets
from scenes.synthesis.deferred import Shader, as_texture
from scenes.synthesis.vertex_light import lit_scene
from uika.head import HeadParameters, load_head, look_at, pose_vertices

SAMPLES = (1, 4, 16, 64, 256)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--reference", type=int, default=4096, help="samples per pixel of the reference")
    parser.add_argument("--renders", type=int, default=1000, help="renders of the memory curve")
    options = parser.parse_args(argv)
    rows, resident = quality(options.size, options.reference), memory(options.renders)
    shown = [
        {
            "method": row["method"],
            "samples per pixel": row["spp"],
            "wall s": f"{row['seconds']:.3f}",
            "processor s": f"{row['cpu']:.3f}",
            "sRGB RMSE": f"{row['rmse']:.5f}",
        }
        for row in rows
    ]
    text = (
        f"{options.size} x {options.size} pixels in studio light, against {options.reference} samples, in the mask:\n\n"
        f"{markdown(shown)}\n\n{options.renders} renders of a moving head hold {min(resident)} to {max(resident)} MB."
        "\n\n"
        "![](mitsuba_spp.png)"
    )
    save("mitsuba_spp", "Mitsuba: samples, time and error", text, {"quality": rows, "memory MB": resident})
    draw(rows, resident, options.renders)


def draw(rows: list[dict[str, Any]], resident: list[float], renders: int) -> None:
    """Error over time, and memory over renders."""
    errors: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        errors.setdefault(row["method"], []).append((row["cpu"], row["rmse"]))
    step = max(1, renders // len(resident))
    curve = [(step * (k + 1), value) for k, value in enumerate(resident)]
    lines(
        "mitsuba_spp",
        {("processor seconds", "sRGB error"): errors, ("renders", "resident MB"): {"64 x 64 pixels": curve}},
    )


def quality(size: int, reference_spp: int) -> list[dict[str, Any]]:
    """Time and sRGB error of each number of samples, studio light, inside the mask."""
    head = load_head().without_bust
    person = sample_person(3, head)
    albedo, rough = paint(person, head, 512)
    vertices = pose_vertices(
        head, HeadParameters.zeros(head).replace(identity=person.shape), hair_offsets(person, head)
    )
    camera = look_at(25, 5, 0.9, (0.0, -0.01, -0.03), size=size)
    srgb = scenes.linear_to_srgb(albedo)

    def reference(spp: int, seed: int) -> dict[str, np.ndarray]:
        return scenes.render(
            vertices, head, camera, srgb, ("rgb", "mask"), spp, roughness=rough, background=(0, 0, 0), seed=seed
        )

    chunk = min(reference_spp, 512)
    parts = [reference(chunk, 100 + index)["rgb"] for index in range(max(1, reference_spp // chunk))]
    truth, mask = np.mean(parts, 0), reference(64, 0)["mask"] == 1
    rows: list[dict[str, Any]] = []

    def measure(method: str, spp: int, image: np.ndarray, clock: tuple[float, float]) -> None:
        rmse = float(np.sqrt(np.mean((image - truth)[mask] ** 2)))
        seconds, cpu = time.perf_counter() - clock[0], time.process_time() - clock[1]
        rows.append({"method": method, "spp": spp, "seconds": seconds, "cpu": cpu, "rmse": rmse})

    for spp in SAMPLES:
        reference(spp, 1)
        clock = time.perf_counter(), time.process_time()
        measure("direct", spp, reference(spp, 2)["rgb"], clock)
    head_scene, texture = lit_scene(head, "studio"), as_texture(albedo, rough)
    for turn in range(2):
        clock = time.perf_counter(), time.process_time()
        seen = Shader(head_scene, head, vertices, texture, seed=turn).view(camera, 4, ("uv",))
    measure("deferred", 4, scenes.linear_to_srgb(seen["rgb"]) * seen["mask"][..., None], clock)
    return rows


def memory(renders: int) -> list[float]:
    """Resident megabytes at ten moments of many renders of a moving head."""
    head = load_head().without_bust
    camera = look_at(distance=0.9, size=64)
    curve = []
    for index in range(renders):
        scenes.render(head.template * (1 + 1e-4 * index), head, camera, spp=1)
        if index % max(1, renders // 10) == max(1, renders // 10) - 1:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            curve.append(round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1))
    return curve


if __name__ == "__main__":
    main()
