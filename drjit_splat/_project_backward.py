"""Adjoint of the projection: from per-splat moments to the gradients of the inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import Backend, packet, write
from ._ewa import Camera, Shape, project
from ._project import RECORD, Arrays, read_splats
from ._settings import Settings

CAMERA = 16  # 12 entries of the view matrix, then fx, fy, cx, cy


@dataclass(frozen=True)
class InputGradients:
    """Flat Dr.Jit arrays, None where nothing was asked for."""

    means: Any | None  # [N * 3]
    quats: Any | None  # [N * 4]
    scales: Any | None  # [N * 3]
    covars: Any | None  # [N * 9]
    opacities: Any | None  # [N]
    camera: Any | None  # [N * CAMERA], to be summed over the splats


def total_moments(be: Backend, gradients: list[Any], i: Any) -> list[Any]:
    """Moments of splats `i` over all chunks of features."""
    parts = [packet(be, source, 2 * i, 8) for source in gradients]
    return [sum(values[1:], values[0]) for values in zip(*parts, strict=True)]


def projection_adjoint(
    be: Backend,
    arrays: Arrays,
    records: Any,
    visible: Any,
    gradients: list[Any],
    grad_depth: Any | None,
    cam: Camera,
    settings: Settings,
    with_camera: bool,
) -> InputGradients:
    """Gradients of N splats and, per splat, of the camera.

    `gradients` holds what each chunk's adjoint added up, `grad_depth` is the gradient of the depth feature [N].
    """
    J, A = be.plain, be.ad
    n = arrays.count
    i = dr.arange(J.UInt32, n)
    mean, shape, opacity = read_splats(be, arrays, i)
    leaves = [[A.Float(v) for v in row] for row in (mean, shape.quat, shape.scale, shape.covariance, [opacity])]
    view, intrinsics = [A.Float(v) for v in cam.view], [A.Float(v) for v in cam.intrinsics]
    if with_camera:
        # One register a splat: a shared one would turn every use into a reduction over all splats.
        spread = A.Float(dr.gather(J.Float, arrays.opacities, i)) * 0.0
        view, intrinsics = [v + spread for v in view], [v + spread for v in intrinsics]
        dr.enable_grad(view, intrinsics)
    dr.enable_grad(leaves)
    limits = (cam.width, cam.height, cam.near, cam.far, cam.eps2d, cam.radius_clip)
    twin = Camera(view, intrinsics, *(A.Float(limit) for limit in limits))
    e = project(leaves[0], Shape(leaves[1], leaves[2], leaves[3]), leaves[4][0], twin, settings)
    outputs = e.geometry()

    m = total_moments(be, gradients, i)
    _, _, a, h, d = packet(be, records, i * (RECORD // 8), 8)[:5]
    ln2 = math.log(2.0)
    output_gradients = [
        2 * ln2 * a * m[1],
        2 * ln2 * dr.fma(a * h, m[1], d * m[2]),
        -ln2 * m[3],
        -2 * ln2 * a * m[4],
        -ln2 * m[5],
        ln2 * m[0],
    ]
    if grad_depth is not None:
        outputs.append(e.z)
        output_gradients.append(grad_depth)
    for output, gradient in zip(outputs, output_gradients, strict=True):
        dr.set_grad(output, gradient)
    dr.enqueue(dr.ADMode.Backward, outputs)
    dr.traverse(dr.ADMode.Backward)

    def written(values: list[Any]) -> Any:
        if not values:
            return None
        target = dr.empty(J.Float, n * len(values))
        for k, value in enumerate(values):
            # A culled splat's registers may hold infinities, which zero moments would turn into NaNs.
            write(target, dr.select(visible, dr.detach(dr.grad(value), False), 0.0), len(values) * i + k)
        return target

    means, quats, scales, covars, opacities = (written(values) for values in leaves)
    camera = written(view + intrinsics) if with_camera else None
    dr.eval(means, quats, scales, covars, opacities, camera)
    return InputGradients(means, quats, scales, covars, opacities, camera)


def opacity_adjoint(be: Backend, opacities: Any, visible: Any, gradients: list[Any], wanted: bool) -> InputGradients:
    """Gradient of the opacities alone: d log(opacity * factor) / d opacity is 1 / opacity for any constant factor."""
    if not wanted:
        return InputGradients(None, None, None, None, None, None)
    i = dr.arange(be.plain.UInt32, dr.width(opacities))
    moments = total_moments(be, gradients, i)
    positive = visible & (opacities > c.OPACITY_FLOOR)
    gradient = dr.select(positive, moments[0] / dr.select(positive, opacities, 1.0), 0.0)
    dr.eval(gradient)
    return InputGradients(None, None, None, None, gradient, None)
