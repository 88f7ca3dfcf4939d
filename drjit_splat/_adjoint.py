"""Adjoint of the projection: from per-splat moments to the gradients of the inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from ._backend import Backend, flat, packet, write
from ._blend_backward import MOMENTS
from ._inputs import Settings
from ._project import RECORD, Camera, project

CAMERA = 16  # 12 entries of the view matrix, then fx, fy, cx, cy


@dataclass(frozen=True)
class InputGradients:
    """Flat Dr.Jit arrays, None where nothing was asked for."""

    means: Any  # [N * 3]
    quats: Any  # [N * 4]
    scales: Any  # [N * 3]
    opacities: Any  # [N]
    camera: Any | None  # [N * CAMERA], to be summed over the splats


def projection_adjoint(
    be: Backend,
    inputs: tuple[torch.Tensor, ...],
    records: Any,
    visible: Any,
    moments: Any,
    grad_depth: Any | None,
    cam: Camera,
    settings: Settings,
    with_camera: bool,
) -> InputGradients:
    """Gradients of N splats and, per splat, of the camera.

    `inputs` are the float32 means, quats, scales and opacities, `grad_depth` is the gradient of the depth feature [N].
    """
    J, A = be.plain, be.ad
    n = len(inputs[0])
    i = dr.arange(J.UInt32, n)
    sizes = (3, 4, 3, 1)
    leaves = []
    for tensor, size in zip(inputs[:4], sizes, strict=True):
        source = flat(J.Float, tensor)
        leaves.append([A.Float(dr.gather(J.Float, source, size * i + k)) for k in range(size)])
    view, intrinsics = [A.Float(v) for v in cam.view], [A.Float(v) for v in cam.intrinsics]
    if with_camera:
        # One register a splat: a shared one would turn every use into a reduction over all splats.
        spread = A.Float(dr.gather(J.Float, flat(J.Float, inputs[3]), i)) * 0.0
        view, intrinsics = [v + spread for v in view], [v + spread for v in intrinsics]
        dr.enable_grad(view, intrinsics)
    dr.enable_grad(leaves)
    limits = (cam.width, cam.height, cam.near, cam.far, cam.eps2d, cam.radius_clip)
    twin = Camera(view, intrinsics, *(A.Float(limit) for limit in limits))
    e = project(leaves[0], leaves[1], leaves[2], leaves[3][0], twin, settings.antialiased)
    outputs = e.geometry()

    m = packet(be, moments, i, MOMENTS)
    _, _, a, h, d = packet(be, records, i * (RECORD // 8), 8)[:5]
    ln2 = math.log(2.0)
    gradients = [
        2 * ln2 * a * m[1],
        2 * ln2 * dr.fma(a * h, m[1], d * m[2]),
        -ln2 * m[3],
        -2 * ln2 * a * m[4],
        -ln2 * m[5],
        ln2 * m[0],
    ]
    if grad_depth is not None:
        outputs.append(e.z)
        gradients.append(grad_depth)
    for output, gradient in zip(outputs, gradients, strict=True):
        dr.set_grad(output, gradient)
    dr.enqueue(dr.ADMode.Backward, outputs)
    dr.traverse(dr.ADMode.Backward)

    def written(values: list[Any]) -> Any:
        target = dr.empty(J.Float, n * len(values))
        for k, value in enumerate(values):
            # A culled splat's registers may hold infinities, which zero moments would turn into NaNs.
            write(target, dr.select(visible, dr.detach(dr.grad(value), False), 0.0), len(values) * i + k)
        return target

    means, quats, scales, opacities = (written(values) for values in leaves)
    camera = written(view + intrinsics) if with_camera else None
    dr.eval(means, quats, scales, opacities, camera)
    return InputGradients(means, quats, scales, opacities, camera)
