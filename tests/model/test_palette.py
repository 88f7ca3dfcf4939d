import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from uika.model import PRESETS, ModelConfig, SurfaceTexels, build
from uika.model.attribute_heads import AttributeHeads, Palette

Make = Callable[..., dict[str, Any]]


def test_a_palette_is_the_weighted_mean_of_what_was_seen() -> None:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 40, 6, generator=generator)
    colors, confidence = (torch.rand(2, 40, n, generator=generator) for n in (3, 1))
    confidence[:, ::2] = 0
    palette = Palette(6, 5)
    found = palette(features, torch.cat([colors, confidence], -1)).double()
    logits = features.double() @ palette.choose.weight.double().T + palette.choose.bias.double()
    weight = logits.exp() * (confidence.double() + 1e-4)
    expected = torch.einsum("bmk,bmc->bkc", weight / weight.sum(1, keepdim=True), colors.double())
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_a_palette_of_nothing_seen_is_finite() -> None:
    found = Palette(6, 5)(torch.randn(1, 40, 6), torch.zeros(1, 40, 4))
    assert bool((found == 0).all())


def test_a_hidden_texel_can_copy_a_colour_seen_elsewhere() -> None:
    config = PRESETS["tiny"]
    config = dataclasses.replace(config, gaussians=dataclasses.replace(config.gaussians, fusion_bias=8.0))
    heads = AttributeHeads(config)
    with torch.no_grad():
        heads.out_layers["mix"].bias[2] = 20.0  # type: ignore[operator]
    seen = torch.tensor([0.2, 0.5, 0.8, 0.0]).expand(1, 7, 4)
    palette = torch.rand(1, config.palette, 3)
    ones = torch.ones(1, 7, 3)
    surface = SurfaceTexels(points=ones, quats=torch.ones(1, 7, 4) / 2, scales=ones)
    colors = heads(torch.randn(1, 7, config.mlp_width), seen, surface, palette).colors
    expected = torch.sigmoid(4 * (palette[:, 2] - 0.5)).expand(1, 7, 3)
    torch.testing.assert_close(colors[0], expected[0], rtol=0, atol=1e-3)


@pytest.mark.parametrize("least", [0.0, 0.75])
def test_scales_keep_to_their_least_ratio(least: float, small: ModelConfig, make_inputs: Make) -> None:
    gaussians = dataclasses.replace(small.gaussians, least_scale=least)
    model, inputs = build(dataclasses.replace(small, gaussians=gaussians)), make_inputs()
    with torch.no_grad():
        model.gs_decoder.gs_net.out_layers["scaling"].bias.fill_(math.log(0.5))  # type: ignore[union-attr]
        ratio = model(**inputs).scales / inputs["surface"].scales
    torch.testing.assert_close(ratio, torch.full_like(ratio, max(least, 0.5)))


def test_detail_adds_the_fine_relief_of_the_observation_where_colours_are_predicted(
    small: ModelConfig, make_inputs: Make
) -> None:
    small = dataclasses.replace(small, map_size=112)
    gaussians = dataclasses.replace(small.gaussians, fusion_bias=20.0)
    inputs = make_inputs(side=96, map_size=112)
    with torch.no_grad():
        plain, detailed = (
            build(dataclasses.replace(small, gaussians=gaussians, detail=share)).eval()(**inputs)
            for share in (0.0, 0.5)
        )
    size, texel = small.map_size, inputs["texel"]
    inside = torch.zeros(size * size, dtype=torch.bool)
    inside[texel] = True
    reach, expected = size // 52, plain.colors.double()
    seen = plain.aggregate[0].double()
    where = inside.view(size, size).double()[None]
    rows = torch.arange(size)

    def around(values: torch.Tensor) -> torch.Tensor:
        # Twice the mean of a square; zeros count beyond the atlas's border, of colours and of places alike.
        box = ((rows[:, None] - rows).abs() <= reach).double() / (2 * reach + 1)
        return box @ box @ values @ box @ box

    relief = seen - around(seen * where) / around(where)
    expected = expected + 0.5 * relief.flatten(1)[:, texel].T
    torch.testing.assert_close(detailed.colors.double(), expected.clamp(0, 1), rtol=0, atol=1e-5)
    assert (detailed.colors - plain.colors).abs().max() > 0.05
