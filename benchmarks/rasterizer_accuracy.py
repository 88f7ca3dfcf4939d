"""Errors against float64: `python -m benchmarks.rasterizer_accuracy [--small 100]`.

130k @ 512 x 512 against the pair oracle with the kernels' own depth order, random small scenes against the full oracle,
and the default skips against none. Pixels with a decision within 1e-4 of its threshold may take the other branch in
float32: they are counted, and left out where the text says "trusted".
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch

from benchmarks import pair_oracle
from benchmarks.figures import bars
from benchmarks.harness import markdown, save
from benchmarks.splat_scenes import QUICK, Scene, named_scene
from drjit_splat import rasterization
from tests.drjit_splat.common import compare, random_scene

MARGIN = 1e-4
INPUTS = ("means", "quats", "scales", "opacities", "colors")


def large(scene: Scene) -> dict[str, object]:
    """Image and gradient errors of one large scene."""
    single = [t.clone().requires_grad_() for t in scene.tensors[:5]]
    image, alpha, meta = rasterization(*single, *scene.tensors[5:], scene.size, scene.size, packed=False)
    double = [t.double().requires_grad_() for t in scene.tensors[:5]]
    exact = pair_oracle.render(scene, double, meta["depths"][0])
    trusted = exact.margin > MARGIN
    generator = torch.Generator().manual_seed(3)
    weight = torch.randn(exact.image.shape, generator=generator, dtype=torch.float64) * trusted[..., None]
    got = torch.autograd.grad((image[0] * weight.float()).sum(), single)
    want = torch.autograd.grad((exact.image * weight).sum(), double)
    error = (image[0] - exact.image).detach().abs().amax(-1)
    kept = error[trusted]
    row: dict[str, object] = {
        "scene": f"{len(scene.means)} @ {scene.size}",
        "trusted": f"{float(trusted.double().mean()):.4f}",
        "max": f"{float(kept.max()):.1e}",
        "RMSE": f"{float(kept.square().mean().sqrt()):.1e}",
        "max of all": f"{float(error.max()):.1e}",
        "alpha max": f"{float((alpha[0, ..., 0] - exact.alpha).detach().abs()[trusted].max()):.1e}",
    }
    for name, a, b in zip(INPUTS, got, want, strict=True):
        row[name] = f"{float((a - b).norm() / b.norm()):.1e}"
    return row


def small(count: int) -> list[dict[str, object]]:
    """Worst and median errors over random scenes of 300 splats."""
    worst: dict[str, list[float]] = {}
    for seed in range(count):
        c = compare(random_scene(count=300, seed=1000 + seed), 64, 64, margin=MARGIN)
        for name, value in ({"image": c.image, "alpha": c.alpha} | c.gradients).items():
            worst.setdefault(name, []).append(value)
    return [
        {"error": name, "median": f"{sorted(v)[len(v) // 2]:.1e}", "worst": f"{max(v):.1e}", "seed": v.index(max(v))}
        for name, v in worst.items()
    ]


def skipping(scene: Scene) -> dict[str, object]:
    """The default thresholds against none at all."""
    with torch.no_grad():
        image, _, meta = rasterization(*scene.tensors, scene.size, scene.size, packed=False)
        exact = pair_oracle.render(scene, [t.double() for t in scene.tensors[:5]], meta["depths"][0], skips=False)
    error = (image[0] - exact.image).abs()
    return {
        "scene": f"{len(scene.means)} @ {scene.size}",
        "max x 255": f"{255 * float(error.max()):.2f}",
        "RMSE": f"{float(error.square().mean().sqrt()):.1e}",
        "pixels above 1/255": int((error.amax(-1) > 1 / 255).sum()),
    }


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", type=int, default=100, help="number of random small scenes")
    parser.add_argument("--scenes", nargs="+", choices=("30k", "130k", QUICK), default=["30k", "130k"])
    arguments = parser.parse_args(argv)
    scenes = [named_scene(name) for name in arguments.scenes]
    big = [large(scene) for scene in scenes]
    little = small(arguments.small)
    skipped = [skipping(scenes[0])]
    text = "\n\n".join(
        (
            "Head scenes against float64 with the same depth order and skips (gradients: relative L2):",
            markdown(big),
            f"{arguments.small} random scenes of 300 splats on 64 x 64 pixels against the full oracle:",
            markdown(little),
            "Default thresholds against every pair above 1e-7 and no stop:",
            markdown(skipped),
        )
    )
    save("rasterizer_accuracy", "Rasterizer: accuracy", text, {"large": big, "small": little, "skips": skipped})
    errors = {
        str(row["scene"]): {name: float(str(row[name])) for name in ("max", "RMSE", "alpha max", *INPUTS)}
        for row in big
    }
    worst = {key: {str(row["error"]): float(str(row[key])) for row in little} for key in ("median", "worst")}
    bars("rasterizer_accuracy", {"head": errors, f"{arguments.small} random": worst}, "error against float64", log=True)


if __name__ == "__main__":
    main()
