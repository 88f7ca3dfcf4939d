"""What is measured of one random scene: errors against the oracle, and the bounds that every scene must meet."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from drjit_splat import Options, constants, rasterization, reference
from drjit_splat._harmonics import colors_seen_from
from drjit_splat._inputs import Splats
from drjit_splat._settings import Settings
from tests.drjit_splat.common import Comparison, compare

from .scenes import Case, extreme, graded, ordinary

Row = dict[str, Any]
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
    image, _, meta = rasterization(**_arguments(case))
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


def strayed(c: Comparison) -> int:
    """Splats visible on one side only though no threshold is within rounding."""
    clear = c.expected["culling_margin"] > MARGIN
    return int(((c.meta["visible"] != c.expected["visible"]) & clear).sum())


def _errors(case: Case) -> Row:
    c = compare(case.scene, case.width, case.height, **case.options)
    found = {"image": c.image, "alpha": c.alpha, "trusted": c.trusted, "strayed": strayed(c)}
    return found | {"gradients": c.gradients, "mode": case.options["render_mode"]}


def ordinary_errors(seed: int) -> Row:
    """Errors of an ordinary scene."""
    case = ordinary(seed)
    return _errors(case) | skipped_work(case)


def gradient_errors(seed: int) -> Row:
    """Errors of a scene in which every input takes part."""
    return _errors(graded(seed))


def extreme_errors(seed: int) -> Row:
    raise NotImplementedError


def extreme_errors(seed: int) -> Row:
    """Errors of an extreme scene."""
    return _errors(extreme(seed))
