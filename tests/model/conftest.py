import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from uika.model import PRESETS, ModelConfig, Reconstructor, SurfaceTexels

Inputs = dict[str, Tensor | SurfaceTexels | None]


@pytest.fixture(scope="session")
def small() -> ModelConfig:
    """Preset tiny with smaller sizes, for tests of behaviour."""
    tiny = PRESETS["tiny"]
    backbone = dataclasses.replace(tiny.backbone, dim=32, heads=2)
    return dataclasses.replace(
        tiny,
        name="small",
        image_size=32,
        map_size=48,
        token_grid=8,
        backbone=backbone,
        dim=32,
        heads=2,
        dpt_projections=(8, 12, 16, 16),
        dpt_features=16,
        mlp_width=24,
    )


@pytest.fixture(scope="session")
def make_inputs() -> Callable[..., Inputs]:
    def make(views: int = 1, batch: int = 1, side: int = 40, map_size: int = 48) -> Inputs:
        """Photos whose pixels cover the left two thirds of the atlas; texels form a disc."""
        generator = torch.Generator().manual_seed(views)
        centers = (torch.arange(side) + 0.5) / side
        uv = torch.stack([0.66 * centers.expand(side, side), centers[:, None].expand(side, side)])
        axis = torch.arange(map_size) + 0.5 - map_size / 2
        texel = ((axis[:, None] ** 2 + axis**2).sqrt() < 0.48 * map_size).flatten().nonzero()[:, 0]
        count = len(texel)
        surface = SurfaceTexels(
            points=torch.rand(1, count, 3, generator=generator) - 0.5,
            quats=torch.nn.functional.normalize(torch.randn(1, count, 4, generator=generator), dim=-1),
            scales=0.001 + 0.002 * torch.rand(1, count, 3, generator=generator),
            mirror=torch.arange(map_size**2).reshape(map_size, map_size).flip(1),
            lift=0.05 * torch.rand(1, map_size, map_size, generator=generator),
            shape=0.02 * torch.randn(3, map_size, map_size, generator=generator),
            face=torch.linspace(-0.5, 1.5, map_size).clamp(0, 1).expand(1, map_size, map_size),
        )
        return {
            "images": torch.rand(batch, views, 3, side, side, generator=generator),
            "masks": torch.ones(batch, views, 1, side, side),
            "pixel_uv": uv.expand(batch, views, 2, side, side).clone(),
            "pixel_weight": None,
            "texel": texel,
            "surface": surface,
        }

    return make


@pytest.fixture(scope="session")
def perturb() -> Callable[[Reconstructor], Reconstructor]:
    def apply(model: Reconstructor) -> Reconstructor:
        """Move every weight away from its initial value, so that zero-initialised layers take part."""
        generator = torch.Generator().manual_seed(7)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
        return model

    return apply
