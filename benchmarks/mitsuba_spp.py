"""Samples per pixel, time and error of the reference renders against a converged one; memory over many renders.

Run `python -m benchmarks.mitsuba_spp -o out/mitsuba` (minutes; `--reference 256 --renders 50` for a quick look).
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np

import scenes
from benchmarks.chart import line_chart
from scenes.deferred import Shader, as_texture, lit_stage
from scenes.people import paint, sample_person
from scenes.people.hair import hair_offsets
from uika.head import HeadParameters, load_head, look_at, pose_vertices

SAMPLES = (1, 4, 16, 64, 256)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/mitsuba"))
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--reference", type=int, default=4096, help="samples per pixel of the reference")
    parser.add_argument("--renders", type=int, default=1000, help="renders of the memory curve")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    result = {"quality": quality(options.size, options.reference), "memory": memory(options.renders)}
    (options.output / "mitsuba_spp.json").write_text(json.dumps(result, indent=1) + "\n")
    draw(result, options.renders, options.output)
    for row in result["quality"]:
        print("{method:>10} {spp:5d} spp {seconds:8.3f} s {cpu:8.3f} cpu s  rmse {rmse:.5f}".format(**row))
    print("resident MB:", result["memory"])


def draw(result: dict[str, list], renders: int, folder: Path) -> None:
    """Charts of error over time and of memory over renders."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in result["quality"]:
        lines.setdefault(row["method"], []).append((round(row["cpu"], 2), row["rmse"]))
    (folder / "mitsuba_error.svg").write_text(line_chart(lines, "processor seconds", "sRGB error"))
    step = max(1, renders // len(result["memory"]))
    curve = [(step * (k + 1), value) for k, value in enumerate(result["memory"])]
    (folder / "mitsuba_memory.svg").write_text(
        line_chart({f"{min(result['memory'])} to {max(result['memory'])} MB": curve}, "renders", "resident")
    )


def quality(size: int, reference_spp: int) -> list[dict[str, object]]:
    """Time and sRGB error of each number of samples, studio light, inside the mask."""
    head = load_head()
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
    rows: list[dict[str, object]] = []

    def measure(method: str, spp: int, image: np.ndarray, clock: tuple[float, float]) -> None:
        rmse = float(np.sqrt(np.mean((image - truth)[mask] ** 2)))
        seconds, cpu = time.perf_counter() - clock[0], time.process_time() - clock[1]
        rows.append({"method": method, "spp": spp, "seconds": seconds, "cpu": cpu, "rmse": rmse})

    for spp in SAMPLES:
        reference(spp, 1)
        clock = time.perf_counter(), time.process_time()
        measure("direct", spp, reference(spp, 2)["rgb"], clock)
    stage, texture = lit_stage(head, "studio"), as_texture(albedo, rough)
    for turn in range(2):
        clock = time.perf_counter(), time.process_time()
        seen = Shader(stage, head, vertices, texture, seed=turn).view(camera, 4, ("uv",))
    measure("deferred", 4, scenes.linear_to_srgb(seen["rgb"]) * seen["mask"][..., None], clock)
    return rows


def memory(renders: int) -> list[float]:
    """Resident megabytes at ten moments of many renders of a moving head."""
    head = load_head()
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
