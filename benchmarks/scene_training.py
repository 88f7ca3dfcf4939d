"""Splats trained from pictures of a Mitsuba scene: `python -m benchmarks.scene_training`.

Textured meshes are rendered from 48 cameras on two circles, every eighth of which is held out, and written down as
`transforms.json`. Both strategies start at random places, as `drjit-splat train` does without points.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import lines
from benchmarks.harness import save
from drjit_splat.training import Progress, TrainConfig, checkpoint, loop, open_capture, train
from scenes import load_mitsuba, write_png

CAMERAS, DISTANCE, HEIGHTS, FOV = 48, 4.2, (0.6, 1.9), 40.0  # metres, degrees


def scene(mi: Any) -> dict[str, Any]:
    """A few shapes with detailed textures under an even sky."""
    random = np.random.default_rng(3)

    def texture(cells: int, low: float, high: float) -> dict[str, Any]:
        coarse = random.uniform(low, high, (cells, cells, 3)).astype(np.float32)
        return {"type": "bitmap", "bitmap": mi.Bitmap(coarse), "filter_type": "bilinear", "raw": True}

    def shape(kind: str, place: Sequence[float], size: Sequence[float], turn: float, cells: int) -> dict[str, Any]:
        T = mi.ScalarTransform4f
        to_world = T().translate(list(place)) @ T().rotate([0, 0, 1], turn) @ T().scale(list(size))
        return {
            "type": kind,
            "to_world": to_world,
            "bsdf": {"type": "twosided", "material": {"type": "diffuse", "reflectance": texture(cells, 0.05, 0.95)}},
        }

    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sky": {"type": "constant", "radiance": 0.9},
        "ground": shape("disk", (0, 0, -0.6), (1.5, 1.5, 1.0), 0, 24),
        "ball": shape("sphere", (0.55, 0.2, -0.15), (0.45, 0.45, 0.45), 20, 16),
        "box": shape("cube", (-0.5, 0.3, -0.2), (0.35, 0.35, 0.4), 30, 12),
        "bar": shape("cube", (0.0, -0.6, -0.3), (0.7, 0.12, 0.3), -15, 20),
    }


def photograph(folder: Path, size: int, spp: int) -> Path:
    """Render the data set into a folder that has none yet."""
    if (folder / "transforms.json").is_file():
        return folder
    mi = load_mitsuba()
    world = mi.load_dict(scene(mi))
    frames = []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index in range(CAMERAS):
        angle, height = 2 * np.pi * index / CAMERAS * 2.0, HEIGHTS[index * 2 // CAMERAS]
        position = [DISTANCE * np.cos(angle), DISTANCE * np.sin(angle), height]
        to_world = mi.ScalarTransform4f().look_at(position, [0, 0, -0.2], [0, 0, 1])
        film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "rfilter": {"type": "box"}}
        sensor = mi.load_dict({"type": "perspective", "fov": FOV, "to_world": to_world, "film": film})
        image = np.array(mi.render(world, sensor=sensor, spp=spp, seed=index))
        # Splats know no light: pictures are taken as they are, without a transfer curve.
        name = f"images/{index:03d}.png"
        write_png(folder / name, np.clip(image[..., :3] + 1 - image[..., 3:], 0, 1))
        # Mitsuba's sensors look along +Z with X to the left; `transforms.json` wants OpenGL's axes.
        matrix = np.array(to_world.matrix) @ np.diag([-1.0, 1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    document = {"camera_angle_x": np.radians(FOV), "w": size, "h": size, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


PARTS = {  # what a step spends its time on, and the function that all of it lies in
    "rendering": "rasterization",
    "SSIM": "ssim",
    "gradients": "backward",
    "optimizers": "step",
    "strategy": "step_post_backward",
}


def where_time_goes(capture: Any, folder: Path, config: TrainConfig, steps: int = 40) -> dict[str, float]:
    """Milliseconds of a step by part, measured on the run's last state."""
    run = loop._Run(capture, config, checkpoint.load(folder), loop.Processes())
    for _ in range(5):
        run.advance(0.0)
    profiler = cProfile.Profile()
    begun = time.perf_counter()
    profiler.runcall(lambda: [run.advance(0.0) for _ in range(steps)])
    whole = 1000 * (time.perf_counter() - begun) / steps
    found = dict.fromkeys(PARTS, 0.0)
    for (file, _, name), (*_, seconds, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        for part, function in PARTS.items():
            place = {"gradients": "torch/_tensor.py", "optimizers": "optim/adam.py"}.get(part, "drjit_splat")
            if name == function and place in file:
                found[part] += 1000 * seconds / steps
    found["rest"] = whole - sum(found.values())
    return found


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--steps", type=int, default=3500)
    parser.add_argument("--splats", type=int, default=30_000)
    parser.add_argument("--folder", type=Path, default=Path("out/scene_training"))
    arguments = parser.parse_args(argv)
    capture = open_capture(photograph(arguments.folder / f"data_{arguments.size}", arguments.size, arguments.spp))
    rows, curves = [], {}
    for strategy in ("default", "mcmc"):
        config = TrainConfig(
            steps=arguments.steps, strategy=strategy, max_splats=arguments.splats, random_splats=arguments.splats // 3
        )
        seen: list[Progress] = []
        figures = train(capture, arguments.folder / strategy, config, watch=lambda p, _, seen=seen: seen.append(p))
        window = max(1, arguments.steps // 40)
        means = [seen[i : i + window] for i in range(0, len(seen), window)]
        curves[strategy] = [(part[-1].seconds / 60, sum(p.psnr for p in part) / len(part)) for part in means]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows.append({"strategy": strategy, **{k: v for k, v in figures.items() if k != "held_out"}, "peak_mb": peak})
        rows[-1]["ms"] = where_time_goes(capture, arguments.folder / strategy, config)
        print(json.dumps(rows[-1]), flush=True)
    table = ["| strategy | splats | steps | minutes | held-out PSNR | held-out SSIM | peak MB |", "|" + "---|" * 7]
    table += [
        f"| {r['strategy']} | {r['splats']} | {r['steps']} | {r['seconds'] / 60:.1f} | {r['psnr']:.2f} dB "
        f"| {r['ssim']:.4f} | {r['peak_mb']:.0f} |"
        for r in rows
    ]
    parts = list(rows[0]["ms"])
    table += ["", "Milliseconds of a step at the end of the run, by part (under a profiler):", ""]
    table += ["| strategy | " + " | ".join(parts) + " |", "|" + "---|" * (len(parts) + 1)]
    table += [f"| {r['strategy']} | " + " | ".join(f"{r['ms'][part]:.1f}" for part in parts) + " |" for r in rows]
    about = f"{len(capture.photos)} pictures of {arguments.size}^2 pixels, {len(capture.held_out)} held out."
    save("scene_training", "Splats trained from a Mitsuba scene", about + "\n\n" + "\n".join(table), {"rows": rows})
    lines("scene_training", {("minutes", "training PSNR, dB"): curves}, log="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
