"""What each skip saves: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_skips`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from benchmarks.figures import bars
from benchmarks.harness import interleaved, markdown, save
from benchmarks.splat_scenes import Scene, named_scene
from drjit_splat import Options, prepare, rasterization

SWITCHES = {
    "exact tiles": Options(exact_tiles=False),
    "opacity-aware extent": Options(opacity_extent=False),
    "early stop": Options(stop_early=False),
    "off-screen culling": Options(cull_offscreen=False),
}


def cases(scene: Scene) -> dict[str, Callable[[], object]]:
    """Forward + backward with everything on, with each switch off, and with less asked for."""
    size = scene.size
    weight = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(1))
    weight_depth = torch.cat([weight, weight[..., :1]], -1)

    def step(wanted: tuple[int, ...] = (0, 1, 2, 3, 4), options: Options | None = None, mode: str = "RGB") -> None:
        leaves = [t.detach().requires_grad_(i in wanted) for i, t in enumerate(scene.tensors[:5])]
        image = rasterization(*leaves, *scene.tensors[5:], size, size, options=options, render_mode=mode)[0][0]
        gradient = weight if mode == "RGB" else weight_depth
        torch.autograd.grad(image, [leaves[i] for i in wanted], grad_outputs=gradient)

    means, quats, scales, opacities, colors, viewmats, Ks = scene.tensors
    fixed = prepare(means, quats, scales, opacities, viewmats, Ks, size, size)

    def shade() -> None:
        learned: Tensor = colors.detach().requires_grad_()
        torch.autograd.grad(fixed.shade(learned)[0][0], [learned], grad_outputs=weight)

    found: dict[str, Callable[[], object]] = {"all on": step}
    found |= {f"without {name}": (lambda o=options: step(options=o)) for name, options in SWITCHES.items()}
    found["with a depth channel"] = lambda: step(mode="RGB+D")
    found["gradients of colours only"] = lambda: step((4,))
    found["gradients of opacities and colours"] = lambda: step((3, 4))
    found["prepared, colours only"] = shade
    return found


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--scenes", nargs="+", default=["30k", "130k", "heavy"])
    arguments = parser.parse_args(argv)
    rows: dict[str, dict[str, object]] = {}
    best: dict[str, dict[str, float]] = {}
    counters = []
    for name in arguments.scenes:
        scene = named_scene(name)
        run = cases(scene)
        times = interleaved(run, dict.fromkeys(run, arguments.repeats))
        for case, timing in times.items():
            rows.setdefault(case, {"case": case})[name] = timing
            best.setdefault(name, {})[case] = timing.best
        with torch.no_grad():
            meta = rasterization(*scene.tensors, scene.size, scene.size, options=Options(count_skips=True))[2]
        counters.append({"scene": name, "pairs": meta["n_pairs"][0], **meta["n_culled"][0]})
    text = (
        "Forward + backward, minimum / median ms:\n\n"
        + markdown(list(rows.values()))
        + "\n\nWhat the skips left out (splats by reason; pairs of opaque tiles and of bounding boxes; tiles):\n\n"
        + markdown(counters)
    )
    save("rasterizer_skips", "Rasterizer: skips", text, {"times": list(rows.values()), "counters": counters})
    bars("rasterizer_skips", {name: {"": values} for name, values in best.items()}, "forward + backward, ms")


if __name__ == "__main__":
    main()
