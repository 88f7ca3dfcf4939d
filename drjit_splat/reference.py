"""Float64 torch oracle of the rasterizer: the definition of the image, differentiable by autograd.

It evaluates every (pixel, splat) pair, so keep scenes with gradients small (500 splats on 64x64 pixels take about a
second). Nothing of the kernels is shared except `constants.py`, the argument checks and the spherical harmonics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from . import constants as c
from ._compat import settings_of
from ._harmonics import colors_seen_from
from ._inputs import Splats, check_finite, check_shapes, finish
from ._reference_batches import batched, stacked
from ._reference_large import blend_large
from ._reference_lens import see, within_lens
from ._rotations import quats_to_rotations
from ._settings import Options, Settings

LARGE = 1 << 25  # (pixel, splat) pairs beyond which images without gradients are blended a few splats at a time


@dataclass(frozen=True)
class Decisions:
    """The discrete choices behind one camera's image; passing them back makes the image smooth in every input."""

    order: Tensor  # [V] ids of the visible splats, near to far
    keep: Tensor  # [V, H*W] bool: the pair is blended
    clamped: Tensor  # [V, H*W] bool: opacity held at ALPHA_MAX


@dataclass(frozen=True)
class Projection:
    """What the camera makes of N splats."""

    means2d: Tensor  # [N, 2] pixels
    depths: Tensor  # [N] camera z
    covariance: Tensor  # [N, 3] pixels^2: xx, xy, yy with the low-pass
    determinant: Tensor  # [N]
    opacities: Tensor  # [N] after the antialiasing factor
    drawable: Tensor  # [N] bool: between the planes, and its covariance can be inverted
    visible: Tensor  # [N] bool: and neither too faint, nor too small, nor off screen
    margin: Tensor  # [N] relative distance of the closest of these decisions to its threshold (not that of `inria`)
    radii: Tensor  # [N, 2] pixels, integer, zero where culled
    span: Tensor  # [N, 2, 2] first pixel and one past the last, in x and in y, that the rules allow


def _root(splats: Splats) -> Tensor:
    """A matrix [N, 3, 3] that times its transpose is the covariance of each splat."""
    if splats.covars is not None:
        return torch.linalg.cholesky(0.5 * (splats.covars + splats.covars.mT))
    assert splats.quats is not None and splats.scales is not None
    return quats_to_rotations(splats.quats) * splats.scales[:, None, :]


def project(splats: Splats, viewmat: Tensor, K: Tensor, settings: Settings, radial: Tensor | None = None) -> Projection:
    """EWA projection of all splats by one camera."""
    s = settings
    points = splats.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = points[:, 2]
    in_range = (depths > s.near) & (depths < s.far_plane) & within_lens(points, s, radial)
    points = torch.where(in_range[:, None], points, torch.ones_like(points))
    means2d, jacobian = see(points, K, s, radial)
    rows = jacobian @ viewmat[:3, :3]
    half = rows @ _root(splats)
    xx, xy, yy = (half[:, 0] ** 2).sum(-1), (half[:, 0] * half[:, 1]).sum(-1), (half[:, 1] ** 2).sum(-1)
    # The determinant of half @ half^T as a sum of squared minors: xx * yy - xy^2 cancels for needles.
    sharp = (torch.linalg.cross(half[:, 0], half[:, 1]) ** 2).sum(-1)
    determinant = sharp + s.eps2d * (xx + yy) + s.eps2d**2
    covariance = torch.stack([xx + s.eps2d, xy, yy + s.eps2d], -1)
    shape_determinant = determinant
    invertible = (determinant > c.DET_MIN) & (determinant < c.DET_MAX)
    determinant = torch.where(invertible, determinant, torch.ones_like(determinant))
    opacities = splats.opacities
    if s.antialiased:
        opacities = opacities * (sharp / determinant).clamp_min(c.COMPENSATION_MIN).sqrt()

    alpha_min = s.options.alpha_min
    bright = opacities.detach() >= alpha_min
    log_reach = 2 * torch.log(opacities.detach().clamp_min(alpha_min) / alpha_min)
    extent = (log_reach[:, None] * covariance.detach()[:, [0, 2]]).sqrt()
    image_size = torch.tensor([s.width, s.height], dtype=means2d.dtype, device=means2d.device)
    on_screen = ((means2d + extent > 0.5) & (means2d - extent < image_size - 0.5)).all(-1)
    reach, extent = extent, extent.ceil()
    span = torch.stack([torch.zeros_like(extent), image_size.expand_as(extent)], -1)
    if s.inria:
        mean = 0.5 * (covariance[:, 0] + covariance[:, 2]).detach()
        half_difference = (mean**2 - determinant.detach()).clamp_min(c.EIGENVALUE_FLOOR_INRIA).sqrt()
        radius = (3 * (mean + half_difference).sqrt()).ceil()
        extent = torch.stack([radius, radius], -1)
        tile, corner = c.TILE_INRIA, means2d.detach() - 0.5
        first = ((corner - extent) / tile).floor().clamp_min(0)
        end = torch.minimum(((corner + extent + (tile - 1)) / tile).floor(), (image_size / tile).ceil())
        span = tile * torch.stack([first, end], -1)
        on_screen &= (first < end).all(-1)
    visible = in_range & invertible & bright & on_screen & (extent > s.radius_clip).any(-1)
    radii = torch.where(visible[:, None], extent, torch.zeros_like(extent)).to(torch.int32)
    drawable = (in_range & invertible).detach()
    margin = _culling_margin(depths, shape_determinant, opacities, means2d, reach, s).detach()
    return Projection(
        means2d, depths, covariance, determinant, opacities, drawable, visible.detach(), margin, radii, span
    )


def _culling_margin(
    depths: Tensor, determinant: Tensor, opacities: Tensor, means2d: Tensor, extent: Tensor, settings: Settings
) -> Tensor:
    s = settings
    near = torch.minimum((depths - s.near).abs() / max(s.near, 1e-12), (depths / s.far_plane - 1).abs())
    for limit in (c.DET_MIN, c.DET_MAX):
        near = torch.minimum(near, (determinant / limit - 1).abs())
    near = torch.minimum(near, (opacities / s.options.alpha_min - 1).abs())
    if s.radius_clip:
        near = torch.minimum(near, (extent / s.radius_clip - 1).abs().amin(-1))
    size = torch.tensor([s.width, s.height], dtype=means2d.dtype, device=means2d.device)
    room = torch.minimum((means2d + extent - 0.5).abs(), (means2d - extent - size + 0.5).abs())
    return torch.minimum(near, (room / (1 + means2d.abs() + extent)).amin(-1))


def _pixel_centres(settings: Settings, like: Tensor) -> tuple[Tensor, Tensor]:
    ys, xs = torch.meshgrid(
        torch.arange(settings.height, dtype=like.dtype, device=like.device) + 0.5,
        torch.arange(settings.width, dtype=like.dtype, device=like.device) + 0.5,
        indexing="ij",
    )
    return xs.reshape(1, -1), ys.reshape(1, -1)


def raw_alphas(projection: Projection, settings: Settings, order: Tensor) -> Tensor:
    """opacity * exp(-sigma) [V, H*W] of the splats `order` at all pixels, before any threshold."""
    p = projection
    xs, ys = _pixel_centres(settings, p.means2d)
    dx, dy = xs - p.means2d[order, 0:1], ys - p.means2d[order, 1:2]
    xx, xy, yy = (p.covariance[order, i : i + 1] for i in range(3))
    sigma = 0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / p.determinant[order, None]
    return p.opacities[order, None] * torch.exp(-sigma)


def blend(
    projection: Projection, features: Tensor, settings: Settings, order: Tensor | None, decisions: Decisions | None
) -> tuple[Tensor, Tensor, Decisions | None, Tensor]:
    """Blend features [N, D] front to back.

    Returns:
        The sums [H, W, D], the coverage [H, W, 1], the decisions taken (unless they are too many) and, for each pixel
        [H, W], the relative distance of its closest decision to its threshold.
    """
    p = projection
    if decisions is not None:
        order = decisions.order
    else:
        order = torch.argsort(p.depths.detach(), stable=True) if order is None else order
        order = order[p.visible[order]]
    xs, ys = _pixel_centres(settings, p.means2d)
    shape = (settings.height, settings.width)
    followed = any(t.requires_grad for t in (p.means2d, p.covariance, p.opacities, features))
    if decisions is None and not followed and len(order) * xs.numel() > LARGE:
        names = ("means2d", "covariance", "determinant", "opacities", "span")
        splats = {name: getattr(p, name)[order] for name in names} | {"features": features[order]}
        sums, coverage, margin = blend_large(splats, torch.cat([xs, ys]).T, settings)
        return sums.reshape(*shape, -1), coverage.reshape(*shape, 1), None, margin.reshape(shape)
    raw = raw_alphas(p, settings, order)

    alpha_min, alpha_max, t_min = settings.options.alpha_min, settings.alpha_max, settings.options.transmittance_min
    clamped = raw.detach() > alpha_max if decisions is None else decisions.clamped
    alpha = torch.where(clamped, torch.full_like(raw, alpha_max), raw)
    (left, right), (top, bottom) = p.span[order].unbind(-2)[0].T[..., None], p.span[order].unbind(-2)[1].T[..., None]
    allowed = (xs > left) & (xs < right) & (ys > top) & (ys < bottom)
    hit = (alpha.detach() >= alpha_min) & allowed
    if decisions is None:
        after = torch.cumsum(torch.log1p(-alpha.detach() * hit), 0).exp()
        keep = hit & (after > t_min)
    else:
        keep = decisions.keep
    alpha = torch.where(keep, alpha, torch.zeros_like(alpha))
    if settings.closing and decisions is None:
        stops = hit & (after <= t_min)
        alpha = torch.where(stops & (torch.cumsum(stops, 0) == 1), torch.ones_like(alpha), alpha)
    log_after = torch.cumsum(torch.log1p(-alpha), 0)
    before = torch.cat([torch.zeros_like(log_after[:1]), log_after[:-1]]).exp()
    sums = (alpha * before).T @ features[order]
    coverage = -torch.expm1(log_after[-1:].T) if len(order) else torch.zeros_like(xs).T

    margin = torch.full_like(xs[0], torch.inf)
    if decisions is None and len(order):
        reached = (before.detach() > t_min) & allowed
        free = raw.detach()
        near = torch.minimum((free / alpha_min - 1).abs(), (free / alpha_max - 1).abs())
        near = torch.minimum(near, torch.where(hit, (after / t_min - 1).abs(), torch.full_like(after, torch.inf)))
        margin = torch.where(reached, near, torch.full_like(near, torch.inf)).amin(0)
    taken = Decisions(order, keep, clamped)
    return sums.reshape(*shape, -1), coverage.reshape(*shape, 1), taken, margin.reshape(shape)


def rasterization(
    means: Tensor,  # [..., N, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    colors: Tensor | None,  # [..., (C,) N, D] or [..., (C,) N, K, D]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    *,
    backgrounds: Tensor | None = None,  # [..., C, D]
    covars: Tensor | None = None,  # [..., N, 3, 3]
    radial_coeffs: Tensor | None = None,  # [..., C, 4]
    options: Options | None = None,
    order: Tensor | None = None,
    decisions: list[Decisions] | None = None,
    **arguments: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render as `drjit_splat.rasterization` does, in float64.

    The arguments that are not listed are those of `drjit_splat.rasterization`.

    Args:
        order: [..., C, N] splat ids near to far; by default the float64 depths decide.
        decisions: `meta["decisions"]` of an earlier call: keep its order, skips and clamps whatever the values are.

    Returns:
        colors [..., C, H, W, D], alphas [..., C, H, W, 1] in float64 and meta with `means2d`, `depths`, `radii` and
        `visible` (as in the fast path, not packed), `decisions` (one a camera; None where more than `LARGE` pairs were
        blended without gradients), `margin` [..., C, H, W]: how close, relatively, the pixel's closest threshold is,
        and `culling_margin` [..., C, N], the same of each splat's visibility; compare only what exceeds the rounding
        error of the tested code.

    Raises:
        ValueError: an argument has a wrong shape, type or value, or holds a NaN or an infinity.
    """
    settings = settings_of(width, height, options, arguments)
    if covars is not None:
        quats = scales = None
    given = Splats(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, radial_coeffs)
    check_shapes(given, settings)
    check_finite(**{name: tensor for name, tensor in vars(given).items() if tensor is not None})
    double = given.to(torch.float64)
    batches = double.batches(settings)
    orders = [None] * len(batches) if order is None else order.reshape(len(batches), -1, means.shape[-2])
    cameras = len(decisions or ()) // len(batches)
    first = [decisions and decisions[b * cameras :][:cameras] for b in range(len(batches))]
    found = [images(s, settings, o, d) for s, o, d in zip(batches, orders, first, strict=True)]
    if not given.batch:
        return found[0]
    colors_, alphas, metas = zip(*found, strict=True)
    return stacked(colors_, given), stacked(alphas, given), batched(metas, given)


def images(
    splats: Splats, settings: Settings, order: Tensor | None, decisions: list[Decisions] | None
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Images of all cameras, without batch dimensions."""
    images, coverages, metas = [], [], []
    for i in range(len(splats.viewmats)):
        viewmat, K = splats.viewmats[i], splats.Ks[i]
        radial = None if splats.radial_coeffs is None else splats.radial_coeffs[i]
        projection = project(splats, viewmat, K, settings, radial)
        parts = []
        if settings.has_colors and settings.sh_degree is None:
            parts.append(splats.colors_of(i, settings))
        elif settings.has_colors:
            harmonics = splats.colors_of(i, settings)
            parts.append(colors_seen_from(harmonics, splats.means, viewmat, int(settings.sh_degree or 0)))
        if settings.has_depth:
            parts.append(projection.depths[:, None])
        sums, coverage, taken, margin = blend(
            projection,
            torch.cat(parts, -1),
            settings,
            None if order is None else order[i],
            None if decisions is None else decisions[i],
        )
        background = None if splats.backgrounds is None else splats.backgrounds[i]
        images.append(finish(sums, coverage, background, settings))
        coverages.append(coverage)
        metas.append((projection, taken, margin))
    meta = {
        "means2d": torch.stack([p.means2d for p, _, _ in metas]),
        "depths": torch.stack([p.depths for p, _, _ in metas]),
        "radii": torch.stack([p.radii for p, _, _ in metas]),
        "visible": torch.stack([p.visible for p, _, _ in metas]),
        "culling_margin": torch.stack([p.margin for p, _, _ in metas]),
        "decisions": [taken for _, taken, _ in metas],
        "margin": torch.stack([margin for _, _, margin in metas]),
    }
    return torch.stack(images), torch.stack(coverages), meta
