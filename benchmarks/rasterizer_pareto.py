"""Run time against error: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_pareto`.

Forward + backward at 130k @ 512 x 512 under different thresholds, exponentials and tile tests, in turns. Errors are
against the float64 image of every pair above 1e-7 that never stops a pixel.
"""

from __future__ import annotations

import argparse

import torch

from benchmarks import pair_oracle
from benchmarks.rasterizer_common import RESULTS, interleaved, markdown, save
from benchmarks.splat_scenes import head_scene
from drjit_splat import Options, rasterization

CHOICES: dict[str, dict[str, Options]] = {
    "alpha threshold": {
        "1/64": Options(alpha_min=1 / 64),
        "1/255 (default)": Options(),
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
    },
    "both": {
        "1/64, 1e-2": Options(alpha_min=1 / 64, transmittance_min=1e-2),
        "1/512, 1e-6": Options(alpha_min=1 / 512, transmittance_min=1e-6),
        "1e-6, none": Options(alpha_min=1e-6, transmittance_min=1e-30),
    },
}


def figure(rows: list[dict[str, object]]) -> None:
    """Time against RMSE, one colour for each kind of setting."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawing, axes = pyplot.subplots(figsize=(9, 5.5), dpi=110)
    for group in CHOICES:
        points = [r for r in rows if r["group"] == group]
        axes.scatter(
            [float(str(r["RMSE"])) for r in points], [float(str(r["f + b ms"])) for r in points], s=42, label=group
        )
    placed: list[tuple[float, float]] = []
    for row in sorted(rows, key=lambda r: float(str(r["f + b ms"]))):
        x, y = float(str(row["RMSE"])), float(str(row["f + b ms"]))
        clash = sum(0.6 < x / a < 1.7 and abs(y / b - 1) < 0.06 for a, b in placed)
        placed.append((x, y))
        axes.annotate(str(row["setting"]), (x, y), xytext=(7, 4 + 11 * clash), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("RMSE against the image without skips")
    axes.set_ylabel("forward + backward, ms")
    axes.set_title("130,000 splats on 512 x 512 pixels")
    axes.grid(True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
    drawing.tight_layout()
    drawing.savefig(RESULTS / "rasterizer_pareto.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--count", type=int, default=130_000)
    parser.add_argument("--size", type=int, default=512)
    arguments = parser.parse_args()
    scene = head_scene(arguments.count, arguments.size)
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]
    weight = torch.rand(scene.size, scene.size, 3, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        meta = rasterization(*scene.tensors, scene.size, scene.size)[2]
        exact = pair_oracle.render(scene, [t.double() for t in scene.tensors[:5]], meta["depths"][0], skips=False).image

    def both(options: Options) -> None:
        image = rasterization(*leaves, *scene.tensors[5:], scene.size, scene.size, options=options)[0][0]
        torch.autograd.grad(image, leaves, grad_outputs=weight)

    settings = {(group, name): options for group, found in CHOICES.items() for name, options in found.items()}
    runs = {f"{group}: {name}": (lambda o=options: both(o)) for (group, name), options in settings.items()}
    times = interleaved(runs, dict.fromkeys(runs, arguments.repeats))
    rows: list[dict[str, object]] = []
    for (group, name), options in settings.items():
        with torch.no_grad():
            image, _, meta = rasterization(*scene.tensors, scene.size, scene.size, options=options)
        error = (image[0] - exact).abs()
        timing = times[f"{group}: {name}"]
        rows.append(
            {
                "group": group,
                "setting": name,
                "f + b ms": f"{timing.best:.1f}",
                "median": f"{timing.median:.1f}",
                "CPU ms": f"{timing.cpu:.0f}",
                "RMSE": f"{float(error.square().mean().sqrt()):.2e}",
                "max": f"{float(error.max()):.1e}",
                "pairs": meta["n_pairs"][0],
            }
        )
    text = (
        f"{arguments.count} splats, {arguments.size} x {arguments.size}, forward + backward, minimum and median ms\n\n"
        f"{markdown(rows)}\n\n![](rasterizer_pareto.png)"
    )
    save("rasterizer_pareto", "Rasterizer: run time against error", text, {"rows": rows})
    figure(rows)


if __name__ == "__main__":
    main()
