"""Images per second of `uika synthesize`, and where the time goes.

Run `python -m benchmarks.synthesis_speed`; writes `benchmarks/results/synthesis_speed.{json,md,png}`. Each image is
written with mask, correspondences and depth, as a file and again in a shard.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import bars
from benchmarks.harness import markdown, save
from scenes.people import paint, sample_person
from scenes.people.hair import hair_offsets
from scenes.synthesis.deferred import Shader, as_texture
from scenes.synthesis.lighting import sample_lighting
from scenes.synthesis.vertex_light import lit_scene
from uika.data import Synthesis, synthesize
from uika.data.encode import DEPTH_UNIT, UV_STEPS, encode_pixels, encode_uv
from uika.data.identity import texture_size
from uika.data.performance import place_camera, viewpoints
from uika.head import HeadParameters, load_head, pose_vertices

VIEWS = 9


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 512])
    parser.add_argument("--identities", type=int, default=3)
    parser.add_argument("--frames", type=int, default=13)
    options = parser.parse_args(argv)
    rows: list[dict[str, object]] = []
    spent: dict[str, dict[str, float]] = {}
    for size in options.sizes:
        found = throughput(size, options.identities, options.frames)
        spent[f"{size} x {size}"] = stages(size, options.frames)
        rows.append({"size": size} | {name: f"{value:.3g}" for name, value in found.items()})
        print(rows[-1], flush=True)
    parts = [
        {"stage": name, **{size: f"{values[name]:.3g}" for size, values in spent.items()}}
        for name in next(iter(spent.values()))
    ]
    text = (
        f"{options.identities} people, {VIEWS} views, {options.frames} frames. Colour and mask at 4 samples a pixel,\n"
        f"correspondences and depth; PNG files and shards written.\n\n{markdown(rows)}\n\n"
        f"Processor milliseconds per image of each stage, taken one after the other:\n\n{markdown(parts)}"
    )
    save("synthesis_speed", "Making training data", text, {"rows": rows, "stages ms": spent})
    bars("synthesis_speed", {"stages": spent}, "processor ms per image")


def throughput(size: int, identities: int, frames: int) -> dict[str, float]:
    """Images per second of whole runs, and the kernels that such a run still had to compile."""
    import drjit as dr

    with tempfile.TemporaryDirectory() as folder:
        # Another size compiles the same kernels, so that the measured run does not.
        warm = Synthesis(Path(folder) / "warm", identities, frames=1, size=max(16, size // 4), seed=1)
        synthesize(warm, progress=False)
        dr.set_flag(dr.JitFlag.KernelHistory, True)
        dr.kernel_history_clear()
        start, cpu = time.perf_counter(), time.process_time()
        settings = Synthesis(Path(folder) / "set", identities, VIEWS, frames, size, seed=1)
        images = synthesize(settings, progress=False).images
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    compiled = sum(not entry["cache_hit"] for entry in kernels)
    return {
        "images_per_s": images / wall,
        "cpu_ms_per_image": 1e3 * cpu / images,
        "cores": os.cpu_count() or 1,
        "launches_per_image": len(kernels) / images,
        "compiled": compiled,
    }


def stages(size: int, frames: int) -> dict[str, float]:
    """CPU milliseconds per image of each stage, one after the other."""
    head = load_head().without_bust
    person = sample_person(3, head)
    lighting = sample_lighting(np.random.default_rng(2))
    head_scene = lit_scene(head, lighting.light)
    head_scene.set_lights(lighting.values)
    vertices = pose_vertices(
        head, HeadParameters.zeros(head).replace(identity=person.shape), hair_offsets(person, head)
    )
    cameras = [place_camera(view, size, np.random.default_rng(0)) for view in viewpoints(VIEWS)]
    backdrops = [np.zeros((size, size, 3), np.uint8)] * VIEWS
    texture = as_texture(*paint(person, head, texture_size(size)))
    shader = Shader(head_scene, head, vertices, texture, samples=32 if size < 256 else 64)
    seen = list(shader.stored_views(cameras, backdrops, UV_STEPS, DEPTH_UNIT))

    def encode() -> None:
        for view in seen:
            for pixels in (view.rgb, view.mask, view.depth):
                encode_pixels(pixels)
            encode_uv(view.uv)

    return {
        "paint": _cpu(lambda: paint(person, head, texture_size(size))) / (VIEWS * frames),
        "pose": _cpu(lambda: head_scene.pose(head, vertices)) / VIEWS,
        "pose_and_light": _cpu(lambda: Shader(head_scene, head, vertices, texture, samples=32 if size < 256 else 64))
        / VIEWS,
        "views": _cpu(lambda: list(shader.stored_views(cameras, backdrops, UV_STEPS, DEPTH_UNIT))) / VIEWS,
        "png": _cpu(encode) / VIEWS,
    }


def _cpu(work: Callable[[], Any], turns: int = 3) -> float:
    work()
    start = time.process_time()
    for _ in range(turns):
        work()
    return 1e3 * (time.process_time() - start) / turns


if __name__ == "__main__":
    main()
