"""Adjoint of the projection: from the gradients of ellipses, or from per-splat moments, to those of the inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import Backend, packet, write
from ._ewa import Shape, project
from ._lens import Camera
from ._project import RECORD, Arrays, read_splats
from ._settings import Settings

CAMERA = 16  # 12 entries of the view matrix, then fx, fy, cx, cy
LN2 = math.log(2.0)


@dataclass(frozen=True)
class InputGradients:
    """Flat Dr.Jit arrays, None where nothing was asked for."""

    means: Any | None = None  # [N * 3]
    quats: Any | None = None  # [N * 4]
    scales: Any | None = None  # [N * 3]
    covars: Any | None = None  # [N * 9]
    opacities: Any | None = None  # [N]
    camera: Any | None = None  # [N * CAMERA], to be summed over the splats


@dataclass(frozen=True)
class OutputGradients:
    """Gradients of what the projection makes of N splats, flat Dr.Jit arrays."""

    means2d: Any | None = None  # [N * 2]
    conics: Any | None = None  # [N * 3]
    depths: Any | None = None  # [N]
    absolute: Any | None = None  # [N * 2] sums over the pixels of the absolute gradients of the means


def total_moments(be: Backend, gradients: list[Any], i: Any) -> list[Any]:
    """Moments of splats `i` over all chunks of features."""
    parts = [packet(be, source, 2 * i, 8) for source in gradients]
    return [sum(values[1:], values[0]) for values in zip(*parts, strict=True)]


def _mean_gradient(m: list[Any], a: Any, h: Any, d: Any) -> list[Any]:
    return [2 * LN2 * a * m[1], 2 * LN2 * dr.fma(a * h, m[1], d * m[2])]


def seeds_of_moments(be: Backend, records: Any, gradients: list[Any], i: Any) -> list[Any]:
    """Gradients of `Ellipse.geometry()` from what each chunk's adjoint added up."""
    m = total_moments(be, gradients, i)
    _, _, a, h, d = packet(be, records, i * (RECORD // 8), 8)[:5]
    return [*_mean_gradient(m, a, h, d), -LN2 * m[3], -2 * LN2 * a * m[4], -LN2 * m[5], LN2 * m[0]]


def seeds_of_outputs(be: Backend, records: Any, given: OutputGradients, i: Any) -> list[Any]:
    """Gradients of `Ellipse.geometry()` from those of the means and conics, which are a, a h and a h^2 + d, each over
    log2(e) / 2.
    """
    J = be.plain
    _, _, a, h, _ = packet(be, records, i * (RECORD // 8), 8)[:5]
    zero = J.Float(0)
    x, y = [zero] * 2 if given.means2d is None else [dr.gather(J.Float, given.means2d, 2 * i + k) for k in range(2)]
    if given.conics is None:
        return [x, y, zero, zero, zero, zero]
    xx, xy, yy = (dr.gather(J.Float, given.conics, 3 * i + k) * (2 / c.LOG2E) for k in range(3))
    return [x, y, dr.fma(h, dr.fma(h, yy, xy), xx), a * dr.fma(2 * h, yy, xy), yy, zero]


def output_gradients(
    be: Backend, records: Any, visible: Any, gradients: list[Any], *, means2d: bool, conics: bool, absolute: bool
) -> OutputGradients:
    """Gradients of means and conics, and the means' absolute ones, from the moments; what is asked for."""
    if not (means2d or conics or absolute):
        return OutputGradients()
    J = be.plain
    n = dr.width(visible)
    i = dr.arange(J.UInt32, n)
    m = total_moments(be, gradients, i)
    _, _, a, h, d = packet(be, records, i * (RECORD // 8), 8)[:5]

    def written(asked: bool, *values: Any) -> Any:
        if not asked:
            return None
        target = dr.empty(J.Float, n * len(values))
        for k, value in enumerate(values):
            write(target, dr.select(visible, value, 0.0), len(values) * i + k)
        return target

    found = OutputGradients(
        means2d=written(means2d, *_mean_gradient(m, a, h, d)),
        # In the pixel's own axes dx = s - h t.
        conics=written(conics, -0.5 * (m[3] - h * (2 * m[4] - h * m[5])), -(m[4] - h * m[5]), -0.5 * m[5]),
        absolute=written(absolute, 2 * LN2 * a * m[6], 2 * LN2 * m[7]),
    )
    dr.eval(found.means2d, found.conics, found.absolute)
    return found


def projection_adjoint(
    be: Backend,
    arrays: Arrays,
    visible: Any,
    seeds: list[Any],
    grad_depth: Any | None,
    cam: Camera,
    settings: Settings,
    with_camera: bool,
) -> InputGradients:
    """Gradients of N splats and, per splat, of the camera, from those of the ellipses.

    `seeds` are the gradients of `Ellipse.geometry()`, `grad_depth` that of the depth.
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
    radial = [A.Float(k) for k in cam.radial]
    twin = Camera(view, intrinsics, radial, *(A.Float(limit) for limit in limits))
    e = project(leaves[0], Shape(leaves[1], leaves[2], leaves[3]), leaves[4][0], twin, settings)
    outputs, given = e.geometry(), list(seeds)
    if grad_depth is not None:
        outputs.append(e.z)
        given.append(grad_depth)
    for output, gradient in zip(outputs, given, strict=True):
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
        return InputGradients()
    i = dr.arange(be.plain.UInt32, dr.width(opacities))
    moments = total_moments(be, gradients, i)
    positive = visible & (opacities > c.OPACITY_FLOOR)
    gradient = dr.select(positive, moments[0] / dr.select(positive, opacities, 1.0), 0.0)
    dr.eval(gradient)
    return InputGradients(opacities=gradient)
