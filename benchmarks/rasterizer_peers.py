"""Beside Mitsuba's `ellipsoids`: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_peers`.

Mitsuba traces one ray a pixel through the same splats (integrator `volprim_rf_basic`, sorted by hit distance, nothing
projected), so its image is close to ours but not the same; run times are in turns in one process.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.rasterizer_common import interleaved, markdown, save
from benchmarks.splat_scenes import Scene, named_scene, passes
from drjit_splat import rasterization
from drjit_splat.llvm import require

_C0 = 0.28209479177387814


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
                "sh_coeffs": mi.TensorXf(((colors - 0.5) / _C0).numpy()),
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


def functions(scene: Scene) -> tuple[dict[str, Callable[[], object]], float]:
    """What is timed, and the mean absolute difference of the two images."""
    import drjit as dr

    world = mitsuba_scene(scene)
    import mitsuba as mi

    parameters = mi.traverse(world)
    keys = [key for key in parameters.keys() if key.split(".")[-1] in ("data", "opacities", "sh_coeffs")]  # noqa: SIM118
    weight = torch.rand(scene.size, scene.size, 3, generator=torch.Generator().manual_seed(1))
    theirs = mi.TensorXf(weight.numpy())

    def mitsuba_forward() -> Any:
        with dr.suspend_grad():
            image = mi.render(world, spp=1)
        dr.eval(image)
        dr.sync_thread()
        return image

    def mitsuba_both() -> None:
        for key in keys:
            dr.enable_grad(parameters[key])
        parameters.update()
        dr.backward(dr.sum(mi.render(world, parameters, spp=1, spp_grad=1)[:, :, :3] * theirs))
        dr.eval([dr.grad(parameters[key]) for key in keys])
        dr.sync_thread()

    ours = rasterization(*scene.tensors, scene.size, scene.size)[0][0]
    difference = float((torch.from_numpy(mitsuba_forward().numpy()[..., :3].copy()) - ours).abs().mean())
    mine = passes(scene)
    run = {"ours": mine["forward"], "ours f + b": mine["both"]}
    return run | {"mitsuba": mitsuba_forward, "mitsuba f + b": mitsuba_both}, difference


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["30k", "130k"])
    parser.add_argument("--repeats", type=int, default=12)
    arguments = parser.parse_args()
    rows = []
    for name in arguments.scenes:
        run, difference = functions(named_scene(name))
        counts = {key: 3 if key.startswith("mitsuba") else arguments.repeats for key in run}
        times = interleaved(run, counts)
        rows.append(
            {"scene": name}
            | {key: str(timing) for key, timing in times.items()}
            | {
                "ratio": f"{times['mitsuba'].best / times['ours'].best:.0f}x",
                "ratio f + b": f"{times['mitsuba f + b'].best / times['ours f + b'].best:.0f}x",
                "mean difference": f"{difference:.1e}",
            }
        )
    text = "Milliseconds, minimum / median; one ray a pixel in Mitsuba.\n\n" + markdown(rows)
    save("rasterizer_peers", "Rasterizer: beside Mitsuba's ellipsoids", text, {"rows": rows})


if __name__ == "__main__":
    main()
