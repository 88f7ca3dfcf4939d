"""The image differs from that of all splats by no more than the documentation says."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from drjit_splat import Options, constants, rasterization

from .common import random_scene

SIZE = 32


def everything(meta: dict[str, Tensor], colors: Tensor) -> tuple[Tensor, Tensor]:
    """Image [H, W, D] of every pair, however faint, and all opacities [H, W, N] near to far, in float64."""
    order = meta["depths"][0].argsort(stable=True)
    order = order[meta["visible"][0][order]]
    pixel = torch.arange(SIZE, dtype=torch.float64) + 0.5
    offset = (
        torch.stack(torch.meshgrid(pixel, pixel, indexing="xy"), -1)[:, :, None] - meta["means2d"][0][order].double()
    )
    xx, xy, yy = meta["conics"][0][order].double().unbind(-1)
    dx, dy = offset.unbind(-1)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alphas = (meta["opacities"][0][order].double() * (-sigma).exp()).clamp_max(constants.ALPHA_MAX)
    before = torch.cat([torch.ones_like(alphas[..., :1]), (1 - alphas).cumprod(-1)[..., :-1]], -1)
    return (alphas * before) @ colors[order].double(), alphas


@pytest.mark.parametrize("opacity", [0.02, 0.3, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_skipped_work_stays_within_the_bound(seed: int, opacity: float) -> None:
    scene = random_scene(count=400, seed=seed)
    scene["opacities"] *= opacity
    scene.pop("backgrounds")
    options = Options()
    image, _, meta = rasterization(**scene, width=SIZE, height=SIZE, packed=False, options=options)
    exact, alphas = everything(meta, scene["colors"])
    faint = ((alphas < options.alpha_min) & (alphas > 0)).sum(-1)
    bound = 1 - (1 - options.alpha_min) ** faint.double() + options.transmittance_min / (1 - constants.ALPHA_MAX)
    error = (image[0] - exact).abs().amax(-1) / scene["colors"].abs().max()
    assert bool((error <= bound + 1e-5).all())
    assert float(error.max()) > 1e-4  # something was skipped


def test_smaller_thresholds_buy_the_error_back() -> None:
    scene = random_scene(count=400, seed=1)
    scene.pop("backgrounds")
    careful = Options(alpha_min=1e-6, transmittance_min=1e-9)
    image, _, meta = rasterization(**scene, width=SIZE, height=SIZE, packed=False, options=careful)
    assert float((image[0] - everything(meta, scene["colors"])[0]).abs().max()) < 2e-3
