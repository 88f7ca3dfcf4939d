"""Beside other rasterizers that run without CUDA: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_peers`.

gsplat's torch functions (projection) with vectorised torch (see `torch_baseline`), and Mitsuba's `ellipsoids`, which
traces one ray a pixel through the same splats (integrator `volprim_rf_basic`, sorted by hit distance, nothing
projected), so that its image is another model's. Run times are in turns in one process; errors are against the float64
oracle with our depth order, over pixels with no decision within 1e-4 of its threshold.
Of the other packages on PyPI at the time of writing, those that rasterize (amd-gsplat, gswarp, splax, taichi-splatting)
need a GPU.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks import pair_oracle, torch_baseline
from benchmarks.figures import bars
from benchmarks.harness import interleaved, markdown, save
from benchmarks.splat_scenes import NAMES, QUICK, Scene, named_scene
from drjit_splat import rasterization
from drjit_splat.constants import SH_C0
from drjit_splat.llvm import require

MARGIN = 1e-4
INPUTS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Peer:
    """One implementation on one scene."""

    forward: Callable[[], Tensor]  # the image [H, W, 3]
    both: Callable[[], Sequence[Tensor]]  # gradients in the order of INPUTS


def mitsuba_scene(scene: Scene) -> Any:
    """The splats as a Mitsuba scene with our camera."""
    require()
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    means, quats, scales, opacities, colors, viewmats, Ks = scene.tensors
    to_world = torch.linalg.inv(viewmats[0].double()) @ torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0])).double()
    xyzw = quats[:, [1, 2, 3, 0]].contiguous()
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic", "max_depth": 64, "srgb_primitives": False},
            "splats": {
                "type": "ellipsoids",
                "centers": mi.TensorXf(means.numpy()),
                "scales": mi.TensorXf(scales.numpy()),
                "quaternions": mi.TensorXf(xyzw.numpy()),
                "opacities": mi.TensorXf(opacities[:, None].numpy()),
                "sh_coeffs": mi.TensorXf(((colors - 0.5) / SH_C0).numpy()),
                "extent": 3.33,
            },
            "sensor": {
                "type": "perspective",
                "fov": math.degrees(2 * math.atan(scene.size / (2 * float(Ks[0, 0, 0])))),
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f(to_world.tolist()),
                "film": {"type": "hdrfilm", "width": scene.size, "height": scene.size, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 1},
            },
        }
    )


def ours(scene: Scene, weight: Tensor) -> Peer:
    """`drjit_splat`."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]

    def both() -> Sequence[Tensor]:
        image = rasterization(*leaves, *scene.tensors[5:], scene.size, scene.size)[0][0]
        return torch.autograd.grad(image, leaves, grad_outputs=weight)

    @torch.no_grad()
    def forward() -> Tensor:
        return rasterization(*scene.tensors, scene.size, scene.size)[0][0]

    return Peer(forward, both)


def plain_torch(scene: Scene, weight: Tensor) -> Peer:
    """gsplat's projection where it is installed, vectorised torch from there on."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]

    def both() -> Sequence[Tensor]:
        image = torch_baseline.render(*leaves, *scene.tensors[5:], scene.size)
        return torch.autograd.grad(image, leaves, grad_outputs=weight)

    @torch.no_grad()
    def forward() -> Tensor:
        return torch_baseline.render(*scene.tensors, scene.size)

    return Peer(forward, both)


def mitsuba(scene: Scene, weight: Tensor) -> Peer:
    """Mitsuba's ellipsoids."""
    import drjit as dr

    world = mitsuba_scene(scene)
    import mitsuba as mi

    parameters = mi.traverse(world)
    keys = [
        next(key for key in parameters.keys() if key.split(".")[-1] == name)  # noqa: SIM118
        for name in ("data", "opacities", "sh_coeffs")
    ]
    theirs = mi.TensorXf(weight.numpy())

    def forward() -> Tensor:
        with dr.suspend_grad():
            image: Any = mi.render(world, spp=1)
        return torch.from_numpy(image.numpy()[..., :3].copy())

    def both() -> Sequence[Tensor]:
        for key in keys:
            dr.enable_grad(parameters[key])
            dr.clear_grad(parameters[key])
        parameters.update()
        dr.backward(dr.sum(mi.render(world, parameters, spp=1, spp_grad=1)[:, :, :3] * theirs))
        count = len(scene.means)
        data, opacities, harmonics = (
            torch.from_numpy(dr.grad(parameters[key]).numpy().copy()).view(count, -1) for key in keys
        )
        means, scales, xyzw = data.split((3, 3, 4), 1)
        return means, xyzw[:, [3, 0, 1, 2]], scales, opacities[:, 0], harmonics / SH_C0

    return Peer(forward, both)


PEERS: dict[str, tuple[Callable[[Scene, Tensor], Peer], int]] = {  # with the share of the repeats, as a divisor
    "drjit_splat": (ours, 1),
    "torch": (plain_torch, 4),
    "Mitsuba": (mitsuba, 4),
}


def measure(name: str, repeats: int) -> list[dict[str, object]]:
    """A row for each implementation."""
    scene = named_scene(name)
    with torch.no_grad():
        depths = rasterization(*scene.tensors, scene.size, scene.size, packed=False)[2]["depths"][0]
    double = [t.double().requires_grad_() for t in scene.tensors[:5]]
    exact = pair_oracle.render(scene, double, depths)
    trusted = exact.margin > MARGIN
    generator = torch.Generator().manual_seed(1)
    weight = torch.rand(*exact.image.shape, generator=generator) * trusted[..., None]
    wanted = torch.autograd.grad((exact.image * weight).sum(), double)
    peers = {label: make(scene, weight) for label, (make, _) in PEERS.items()}
    run: dict[str, Callable[[], object]] = {}
    for label, peer in peers.items():
        run |= {f"{label} f": peer.forward, f"{label} b": peer.both}
    counts = {f"{label} {way}": max(1, repeats // share) for label, (_, share) in PEERS.items() for way in "fb"}
    times = interleaved(run, counts)
    rows: list[dict[str, object]] = []
    for label, peer in peers.items():
        error = (peer.forward() - exact.image.detach())[trusted]
        row: dict[str, object] = {
            "scene": name,
            "rasterizer": label,
            "forward": times[f"{label} f"],
            "forward + backward": times[f"{label} b"],
            "ratio": f"{times[f'{label} f'].best / times['drjit_splat f'].best:.1f}x",
            "ratio f + b": f"{times[f'{label} b'].best / times['drjit_splat b'].best:.1f}x",
            "RMSE": f"{float(error.square().mean().sqrt()):.1e}",
        }
        for key, got, want in zip(INPUTS, peer.both(), wanted, strict=True):
            row[key] = f"{float((got - want).norm() / want.norm()):.1e}"
        rows.append(row)
        print(row, flush=True)
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=(*NAMES, QUICK), default=["30k", "130k"])
    parser.add_argument("--repeats", type=int, default=12, help="of ours; a quarter of it for the others")
    arguments = parser.parse_args(argv)
    rows = [row for name in arguments.scenes for row in measure(name, arguments.repeats)]
    projection = "gsplat 1.5.3's" if torch_baseline.has_gsplat() else "the oracle's (gsplat is not installed)"
    text = (
        f"Milliseconds, minimum / median; one ray a pixel in Mitsuba; torch with {projection} projection. Errors\n"
        "against float64: RMSE of the image, relative L2 of the gradients. Mitsuba's numbers mean the same splats,\n"
        "but another image of them.\n\n"
    )
    save("rasterizer_peers", "Rasterizer: beside others", text + markdown(rows), {"rows": rows})
    panels = {
        title: {
            str(name): {str(r["rasterizer"]): float(str(r[key]).split()[0]) for r in rows if r["scene"] == name}
            for name in arguments.scenes
        }
        for title, key in (("forward", "forward"), ("forward + backward", "forward + backward"))
    }
    bars("rasterizer_peers", panels, "ms, least", log=True)


if __name__ == "__main__":
    main()
