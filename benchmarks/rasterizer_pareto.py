"""Run time against error: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_pareto`.

Forward + backward on three scenes under different thresholds, exponentials and tile tests, in turns. Errors are against
the float64 image of every pair above 1e-7 that never stops a pixel.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence

import torch

from benchmarks import pair_oracle
from benchmarks.harness import RESULTS, interleaved, markdown, save
from benchmarks.splat_scenes import NAMES, QUICK, named_scene
from drjit_splat import Options, rasterization

DEFAULT = "1/255 (default)"
CHOICES: dict[str, dict[str, Options]] = {
    "alpha threshold": {
        "1/64": Options(alpha_min=1 / 64),
        DEFAULT: Options(),
        "1/512": Options(alpha_min=1 / 512),
        "1e-6": Options(alpha_min=1e-6),
    },
    "transmittance cut": {
        "1e-2": Options(transmittance_min=1e-2),
        "1e-3": Options(transmittance_min=1e-3),
        "1e-6": Options(transmittance_min=1e-6),
        "none": Options(transmittance_min=1e-30, stop_early=False),
    },
    "exponential": {"degree 3": Options(exp_degree=3), "degree 4": Options(exp_degree=4)},
    "tiles": {
        "box": Options(exact_tiles=False),
        "box, opacity ignored": Options(exact_tiles=False, opacity_extent=False),
        "2 to a list": Options(list_width=2),
        "4 to a list": Options(list_width=4),
    },
    "both": {
        "1/64, 1e-2": Options(alpha_min=1 / 64, transmittance_min=1e-2),
        "1/512, 1e-6": Options(alpha_min=1 / 512, transmittance_min=1e-6),
        "1e-6, none": Options(alpha_min=1e-6, transmittance_min=1e-30),
    },
}


SHORT = {
    "alpha threshold": "α {}",
    "transmittance cut": "T {}",
    "exponential": "exp {}",
    "tiles": "{}",
    "both": "α, T {}",
}
LINES = 17  # of text that fit into a panel's height


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The (error, time) points that no other beats in both, by increasing error."""
    kept: list[tuple[float, float]] = []
    for error, time in sorted(points):
        if not kept or time < kept[-1][1]:
            kept.append((error, time))
    return kept


def figure(rows: list[dict[str, object]], scenes: Sequence[str]) -> None:
    """Time against RMSE, a panel for each scene, one colour for each kind of setting, and the front of the best.

    The width is that of a README's column, where the letters are as large as its text.
    """
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9, 3.7 * len(scenes)), dpi=200, layout="constrained")
    for place, scene in enumerate(scenes, 1):
        axes = drawing.add_subplot(len(scenes), 1, place)
        here = [row for row in rows if row["scene"] == scene]
        where = {
            f"{row['group']}: {row['setting']}": (float(str(row["RMSE"])), float(str(row["f + b ms"]))) for row in here
        }
        best = front(list(where.values()))
        axes.plot(*zip(*best, strict=True), color="grey", linewidth=1, drawstyle="steps-post", zorder=0)
        for group in CHOICES:
            points = [point for name, point in where.items() if name.startswith(f"{group}: ")]
            axes.scatter(*zip(*points, strict=True), s=36, label=group)
        default = where[f"alpha threshold: {DEFAULT}"]
        axes.scatter(*default, s=200, marker="*", color="black", zorder=3)
        slow = max(y for _, y in where.values())
        fast = min(y for _, y in where.values())
        for names, (x, y) in clusters(where, (slow / fast) ** (1 / LINES)):
            left = 0.2 * default[0] < x < 0.95 * default[0]
            axes.annotate(
                "; ".join(names),
                (x, y),
                xytext=(-8 if left else 10, 0),
                textcoords="offset points",
                fontsize=9,
                ha="right" if left else "left",
                va="center",
                zorder=1,  # under the points
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.8},
            )
        axes.set(xscale="log", yscale="log", title=scene, xlim=(1e-7, 1), ylim=(fast / 1.06, slow * 1.06))
        axes.set(xlabel="RMSE against the image without skips", ylabel="forward + backward, ms")
        ticks = [
            value for value in (5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 35, 40, 45, 50, 60, 80) if fast <= value <= slow
        ]
        axes.set_yticks(ticks, [str(value) for value in ticks])
        axes.minorticks_off()
        axes.grid(True, alpha=0.25)
        axes.legend(fontsize=9, loc="upper right")
    drawing.savefig(RESULTS / "rasterizer_pareto.png")


def clusters(where: Mapping[str, tuple[float, float]], step: float) -> list[tuple[list[str], tuple[float, float]]]:
    """Settings whose points are too close for two lines of text, by falling time; each gets one label.

    Args:
        where: "group: setting" -> (error, time).
        step: ratio of two times that lie one line apart.
    """
    found: list[tuple[list[str], tuple[float, float]]] = []
    for name, (x, y) in sorted(where.items(), key=lambda item: -item[1][1]):
        near = [each for each in found if each[1][1] / y < step and 1 / 1.6 < each[1][0] / x < 1.6]
        group, _, setting = name.partition(": ")
        text = "default" if setting == DEFAULT else SHORT[group].format(setting.removeprefix("degree "))
        if near:
            min(near, key=lambda each: abs(math.log(each[1][1] / y)))[0].append(text)
        else:
            found.append(([text], (x, y)))
    return found


def measure(name: str, repeats: int) -> list[dict[str, object]]:
    """A row for every setting on one scene."""
    scene = named_scene(name)
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]
    weight = torch.rand(scene.size, scene.size, 3, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        meta = rasterization(*scene.tensors, scene.size, scene.size, packed=False)[2]
        exact = pair_oracle.render(scene, [t.double() for t in scene.tensors[:5]], meta["depths"][0], skips=False).image

    def both(options: Options) -> None:
        image = rasterization(*leaves, *scene.tensors[5:], scene.size, scene.size, options=options)[0][0]
        torch.autograd.grad(image, leaves, grad_outputs=weight)

    settings = {(group, label): options for group, found in CHOICES.items() for label, options in found.items()}
    runs = {f"{group}: {label}": (lambda o=options: both(o)) for (group, label), options in settings.items()}
    times = interleaved(runs, dict.fromkeys(runs, repeats))
    rows: list[dict[str, object]] = []
    for (group, label), options in settings.items():
        with torch.no_grad():
            image, _, meta = rasterization(*scene.tensors, scene.size, scene.size, packed=False, options=options)
        error = (image[0] - exact).abs()
        timing = times[f"{group}: {label}"]
        rows.append(
            {
                "scene": name,
                "group": group,
                "setting": label,
                "f + b ms": f"{timing.best:.1f}",
                "median ms": f"{timing.median:.1f}",
                "CPU ms": f"{timing.cpu:.0f}",
                "RMSE": f"{float(error.square().mean().sqrt()):.2e}",
                "max": f"{float(error.max()):.1e}",
                "pairs": meta["n_pairs"][0],
            }
        )
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--scenes", nargs="+", choices=(*NAMES, QUICK), default=["30k", "130k", "avatar"])
    parser.add_argument("--draw", action="store_true", help="only the picture, from the JSON file of an earlier run")
    arguments = parser.parse_args(argv)
    if arguments.draw:
        rows = json.loads((RESULTS / "rasterizer_pareto.json").read_text())["rows"]
        figure(rows, list(dict.fromkeys(row["scene"] for row in rows)))
        return
    rows = [row for name in arguments.scenes for row in measure(name, arguments.repeats)]
    text = f"Forward + backward, minimum and median ms; `(default)` marks the default.\n\n{markdown(rows)}"
    save("rasterizer_pareto", "Rasterizer: run time against error", text, {"rows": rows})
    figure(rows, arguments.scenes)


if __name__ == "__main__":
    main()
