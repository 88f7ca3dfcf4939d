"""Camera models: where a point in camera space appears, and the Jacobian there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import constants as c
from ._backend import larger, smaller
from ._settings import Settings

_TERMS = 17  # of the series of atan(u) / u; the first one left out is below 1e-11
_NEAR_AXIS = 0.25  # squared tangent of the angle up to which the series serves


@dataclass(frozen=True)
class Camera:
    """One camera as Dr.Jit registers; sizes and limits are opaque so that kernels are reused."""

    view: list[Any]  # 12: rows of the world-to-camera matrix
    intrinsics: list[Any]  # fx, fy, cx, cy
    radial: list[Any]  # 4 coefficients of a distorted fisheye lens, or none
    width: Any
    height: Any
    near: Any
    far: Any
    eps2d: Any
    radius_clip: Any


@dataclass(frozen=True)
class Seen:
    """A point as one camera sees it."""

    x: Any  # pixels
    y: Any
    top: list[Any]  # 3: derivatives of x by the point in the world
    low: list[Any]  # 3: of y
    in_range: Any  # whether it lies between the planes and where the lens model holds


def see(point: list[Any], cam: Camera, settings: Settings) -> Seen:
    """Project a point in camera space."""
    in_range = (point[2] > cam.near) & (point[2] < cam.far)
    if settings.camera_model == "ortho":
        fx, fy, cx, cy = cam.intrinsics
        v = cam.view
        x, y = dr.fma(fx, point[0], cx), dr.fma(fy, point[1], cy)
        return Seen(x, y, [fx * v[k] for k in range(3)], [fy * v[4 + k] for k in range(3)], in_range)
    inv_z = 1 / dr.select(in_range, point[2], 1.0)
    slopes = point[0] * inv_z, point[1] * inv_z
    model = _fisheye if settings.camera_model == "fisheye" else _pinhole
    return model(*slopes, inv_z, in_range, cam, settings)


def _pinhole(u: Any, w: Any, inv_z: Any, in_range: Any, cam: Camera, settings: Settings) -> Seen:
    fx, fy, cx, cy = cam.intrinsics
    v = cam.view

    def clamped(slope: Any, focal: Any, centre: Any, size: Any) -> Any:
        half = 0.5 * size / focal
        if settings.inria:  # symmetric about the optical axis, wherever the image lies
            limit = (1 + c.FRUSTUM_MARGIN) * half
            return smaller(larger(slope, -limit), limit)
        margin = c.FRUSTUM_MARGIN * half
        return smaller(larger(slope, -centre / focal - margin), (size - centre) / focal + margin)

    cu, cw = clamped(u, fx, cx, cam.width), clamped(w, fy, cy, cam.height)
    top = [fx * inv_z * (v[k] - cu * v[8 + k]) for k in range(3)]
    low = [fy * inv_z * (v[4 + k] - cw * v[8 + k]) for k in range(3)]
    return Seen(dr.fma(fx, u, cx), dr.fma(fy, w, cy), top, low, in_range)


def _series(w: Any, coefficients: list[float]) -> Any:
    value = coefficients[-1] + 0 * w
    for coefficient in reversed(coefficients[:-1]):
        value = dr.fma(value, w, coefficient)
    return value


def _polynomial(t: Any, radial: list[Any], weights: tuple[int, ...]) -> Any:
    """1 + k1 t + k2 t^2 + k3 t^3 + k4 t^4, each term times a weight."""
    value: Any = 0 * t
    for k, weight in zip(reversed(radial), reversed(weights[1:]), strict=True):
        value = (value + weight * k) * t
    return value + weights[0]


def _fisheye(u: Any, w: Any, inv_z: Any, in_range: Any, cam: Camera, settings: Settings) -> Seen:
    """Equidistant: the image radius is the angle theta from the axis, times OpenCV's polynomial in theta^2.

    With r^2 = u^2 + w^2 = tan(theta)^2, x = fx u g(r^2) + cx where g = theta_d / r. Near the axis g and its derivative
    come from a series, elsewhere the quotients keep their digits.
    """
    fx, fy, cx, cy = cam.intrinsics
    v = cam.view
    squared = u * u + w * w
    axial = squared < _NEAR_AXIS
    near, far = dr.select(axial, squared, 0.0), dr.select(axial, 1.0, squared)
    signs = [(-1.0) ** n for n in range(_TERMS)]
    angle = _series(near, [s / (2 * n + 1) for n, s in enumerate(signs)])
    slope = _series(near, [n * s / (2 * n + 1) for n, s in enumerate(signs)][1:])
    tangent = dr.sqrt(far)
    ratio = dr.select(axial, angle, dr.atan(tangent) / tangent)  # theta / tan(theta)
    along = 1 / (1 + squared)  # d theta / d tan(theta)
    if cam.radial:
        t = squared * ratio * ratio
        value = _polynomial(t, cam.radial, (1, 1, 1, 1, 1))
        growth = _polynomial(t, cam.radial, (1, 3, 5, 7, 9))  # d theta_d / d theta
        bend = _polynomial(t, cam.radial[1:], (0, 2, 3, 4)) + cam.radial[0]  # d value / d t
        turn = ratio * ratio + 2 * near * ratio * slope
        slope = slope * value + ratio * bend * turn
        ratio, along = ratio * value, along * growth
        in_range &= growth > 0  # beyond, the polynomial folds the outside back into the image
    slope = dr.select(axial, slope, (along - ratio) / (2 * far))
    cross = 2 * slope * u * w
    jx = (ratio + 2 * slope * u * u, cross, -u * along)
    jy = (cross, ratio + 2 * slope * w * w, -w * along)
    top = [fx * inv_z * (jx[0] * v[k] + jx[1] * v[4 + k] + jx[2] * v[8 + k]) for k in range(3)]
    low = [fy * inv_z * (jy[0] * v[k] + jy[1] * v[4 + k] + jy[2] * v[8 + k]) for k in range(3)]
    return Seen(dr.fma(fx, u * ratio, cx), dr.fma(fy, w * ratio, cy), top, low, in_range)


def exact_centre(be: Any, mean: list[Any], cam: Camera, settings: Settings) -> list[Any]:
    """Projected mean relative to the middle of the image (pixels), by way of float64.

    Rounding x and z to float32 before they are divided moves splats by 1e-5 pixels, which is most of an image's error.
    """
    J = be.plain
    x, y, z = (J.Float64(v) for v in mean)
    rows = [[J.Float64(v) for v in cam.view[r : r + 4]] for r in (0, 4, 8)]
    px, py, pz = (dr.fma(v[0], x, dr.fma(v[1], y, dr.fma(v[2], z, v[3]))) for v in rows)
    fx, fy, cx, cy = (J.Float64(v) for v in cam.intrinsics)
    scale = J.Float64(1.0)
    if settings.camera_model != "ortho":
        scale = 1 / dr.select((J.Float(pz) > cam.near) & (J.Float(pz) < cam.far), pz, 1.0)
    if settings.camera_model == "fisheye":
        tangent = dr.sqrt(px * px + py * py) * dr.abs(scale)
        theta = dr.atan(tangent)
        ratio = dr.select(tangent > 1e-12, theta / dr.select(tangent > 1e-12, tangent, 1.0), 1.0)
        if cam.radial:
            ratio *= _polynomial(theta * theta, [J.Float64(k) for k in cam.radial], (1, 1, 1, 1, 1))
        scale *= ratio
    width, height = J.Float64(cam.width), J.Float64(cam.height)
    return [J.Float(dr.fma(fx * px, scale, cx - 0.5 * width)), J.Float(dr.fma(fy * py, scale, cy - 0.5 * height))]
