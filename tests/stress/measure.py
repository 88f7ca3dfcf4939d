"""What is measured of one random scene: errors against the oracle, and the bounds that every scene must meet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from drjit_splat import Options, constants, rasterization, reference
from drjit_splat._harmonics import colors_seen_from
from drjit_splat._inputs import Splats
from drjit_splat._settings import Settings
from tests.drjit_splat.common import compare

from .scenes import Case, extreme, graded, ordinary

Row = dict[str, Any]
LAST_BIT = 2.0**-23
PERTURBED = 4  # scenes that differ from the given one by rounding
FLOOR = 1e-6  # rounding of images that is granted without any perturbation, relative to the brightest
DIGITS, FEW_DIGITS = 1e-4, 1e-3  # the same of gradients, of ordinary and of extreme scenes, relative to their norm
MARGIN = 1e-4  # relative distance to a threshold within which rounding may decide


def _arguments(case: Case) -> dict[str, Any]:
    return {"quats": None, "scales": None} | case.scene | case.options | {"width": case.width, "height": case.height}


def _projected(case: Case, camera: int) -> tuple[reference.Projection, Tensor, Settings]:
    """The oracle's projection, what each splat shows [N, F], and the call's settings."""
    options = {k: v for k, v in case.options.items() if k not in ("quats", "scales")}
    settings = Settings(case.width, case.height, **options)
    splats = Splats(**{"quats": None, "scales": None} | case.scene).to(torch.float64)
    p = reference.project(splats, splats.viewmats[camera], splats.Ks[camera], settings)
    parts = []
    if settings.has_colors:
        colors = splats.colors_of(camera, settings)
        degree = settings.sh_degree
        if degree is not None:
            colors = colors_seen_from(colors, splats.means, splats.viewmats[camera], degree)
        parts.append(colors)
    if settings.has_depth:
        parts.append(p.depths[:, None])
    return p, torch.cat(parts, -1), settings


def skipped_work(case: Case) -> Row:
    """The image beside that of every splat before the camera, however faint; the bound that the manual states.

    `skip_error` is in units of the colours' range, `skip_ratio` the largest share of its bound that a pixel uses.
    """
    image, _, meta = rasterization(**_arguments(case), packed=False)
    worst = {"skip_error": 0.0, "skip_ratio": 0.0}
    options = Options()
    for camera in range(len(image)):
        p, features, settings = _projected(case, camera)
        if settings.expected_depth:
            features = features[:, :-1]  # a quotient has no bound of this kind
            if not features.shape[1]:
                continue
        order = torch.argsort(meta["depths"][camera], stable=True)
        order = order[p.drawable[order]]
        alphas = reference.raw_alphas(p, settings, order).clamp_max(constants.ALPHA_MAX)
        before = torch.cat([torch.ones_like(alphas[:1]), (1 - alphas).cumprod(0)])
        exact = (alphas * before[:-1]).T @ features[order]
        floor = torch.zeros(features.shape[1], dtype=torch.float64)
        if (background := case.scene.get("backgrounds")) is not None and settings.has_colors:
            floor[: background.shape[1]] = background[camera].double()
            exact += before[-1][:, None] * floor
        faint = 1 - (1 - torch.where(alphas < options.alpha_min, alphas, 0.0)).prod(0)
        bound = faint + options.transmittance_min / (1 - constants.ALPHA_MAX)
        shown = torch.cat([features[order], floor[None]])
        found = image[camera].double().reshape(-1, image.shape[-1])[:, : features.shape[1]]
        error = ((found - exact).abs() / (shown.amax(0) - shown.amin(0)).clamp_min(1e-12)).amax(1)
        worst["skip_error"] = max(worst["skip_error"], float(error.max()))
        worst["skip_ratio"] = max(worst["skip_ratio"], float((error / (bound + 1e-5)).max()))
    return worst


def strayed(meta: Mapping[str, Any], expected: dict[str, Any]) -> int:
    """Splats visible on one side only though no threshold is within rounding."""
    clear = expected["culling_margin"] > MARGIN
    return int(((meta["visible"] != expected["visible"]) & clear).sum())


def _errors(case: Case) -> Row:
    c = compare(case.scene, case.width, case.height, **case.options)
    found = {"image": c.image, "alpha": c.alpha, "trusted": c.trusted, "strayed": strayed(c.meta, c.expected)}
    return found | {"gradients": c.gradients, "mode": case.options["render_mode"]}


def ordinary_errors(seed: int) -> Row:
    """Errors of an ordinary scene; where a gradient cancels, also in units of what rounded inputs change."""
    case = ordinary(seed)
    row = _errors(case)
    ratios = {name: error / DIGITS for name, error in row["gradients"].items()}
    if max(ratios.values()) > 1:
        ratios = conditioned_errors(case, DIGITS)["gradient_ratios"]
    return row | {"gradient_ratios": ratios} | skipped_work(case)


def gradient_errors(seed: int) -> Row:
    """Errors of a scene in which every input takes part."""
    return _errors(graded(seed))


def _oracle(
    case: Case, scene: dict[str, Tensor], weights: tuple[Tensor, Tensor] | None, **options: Any
) -> tuple[Tensor, Tensor, dict[str, Tensor], dict[str, Any]]:
    """Image, coverage, gradients of a weighted sum of both, and meta, in float64."""
    leaves = {k: v.double().requires_grad_() for k, v in scene.items()}
    image, alpha, meta = reference.rasterization(
        **leaves, **case.options, **options, width=case.width, height=case.height
    )
    found = {}
    if weights is not None:
        ((image * weights[0]).sum() + (alpha * weights[1]).sum()).backward()
        found = {k: v.grad for k, v in leaves.items() if v.grad is not None}
    return image.detach(), alpha.detach(), found, meta


def extreme_errors(seed: int) -> Row:
    """Errors of an extreme scene."""
    return conditioned_errors(extreme(seed), FEW_DIGITS)


def conditioned_errors(case: Case, floor: float) -> Row:
    """Errors in units of what the last bit of the inputs changes in the oracle.

    Needles a millionth of a pixel wide have no digits to lose: an input that is off by its own rounding moves them by
    more than their width. A sound computation in float32 stays within a few times that, whatever the scene. Of
    gradients, `floor` times their norm is granted besides.
    """
    leaves = {k: v.clone().requires_grad_() for k, v in case.scene.items()}
    image, alpha, meta = rasterization(**leaves, **case.options, width=case.width, height=case.height, packed=False)
    order = torch.argsort(meta["depths"], dim=-1, stable=True)
    _, _, _, expected = _oracle(case, case.scene, None, order=order)
    trusted = (expected["margin"] > MARGIN)[..., None]
    g = torch.Generator().manual_seed(99)
    weights = (
        torch.randn(image.shape, generator=g, dtype=torch.float64) * trusted,
        torch.randn(alpha.shape, generator=g, dtype=torch.float64) * trusted,
    )
    ((image * weights[0].float()).sum() + (alpha * weights[1].float()).sum()).backward()
    held = {"decisions": expected["decisions"]}
    wanted, wanted_alpha, gradients, _ = _oracle(case, case.scene, weights, **held)
    moved_image, moved_alpha = torch.zeros_like(wanted), torch.zeros_like(wanted_alpha)
    moved = {k: torch.zeros((), dtype=torch.float64) for k in gradients}
    for _ in range(PERTURBED):
        near = {
            k: v.double() * (1 + LAST_BIT * (torch.rand(v.shape, generator=g) * 2 - 1)) for k, v in case.scene.items()
        }
        near["Ks"][:, 2, 2] = 1
        other, other_alpha, others, _ = _oracle(case, near, weights, **held)
        moved_image = torch.maximum(moved_image, (other - wanted).abs() * trusted)
        moved_alpha = torch.maximum(moved_alpha, (other_alpha - wanted_alpha).abs() * trusted)
        moved = {k: torch.maximum(m, (others[k] - gradients[k]).norm()) for k, m in moved.items()}
    error, error_alpha = (image - wanted).detach().abs() * trusted, (alpha - wanted_alpha).detach().abs() * trusted
    scale = 1 + wanted.abs().max()
    ratios, errors = {}, {}
    for name, want in gradients.items():
        got = leaves[name].grad
        assert got is not None and torch.isfinite(got).all(), name
        off = (got - want).norm()
        errors[name] = float(off / want.norm().clamp_min(1e-12))
        ratios[name] = float(off / (floor * want.norm() + moved[name]).clamp_min(1e-12))
    shown, hidden = image.detach()[..., :3], ~meta["visible"].any(0)
    return {
        "image": float(error.max()),
        "alpha": float(error_alpha.max()),
        "image_ratio": float(error.max() / (FLOOR * scale + moved_image.max())),
        "alpha_ratio": float(error_alpha.max() / (FLOOR + moved_alpha.max())),
        "gradients": errors,
        "gradient_ratios": ratios,
        "trusted": float(trusted.double().mean()),
        "visible": int(meta["visible"].sum()),
        "strayed": strayed(meta, expected),
        "finite": bool(torch.isfinite(image).all()),
        "range": [float(shown.min()), float(shown.max())],
        "hidden_gradient": float(leaves["means"].grad[hidden].abs().sum()),
    }
