"""Catalogue lines 18 to 24 and 28 to 32: arguments, sizes, orders and uses of a call."""

from __future__ import annotations

import math
import re

import pytest
import torch

from drjit_splat import rasterization
from tests.drjit_splat.common import one_splat, random_scene, render_with_gradients


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_18_a_value_that_is_not_finite_is_named(name: str, value: float) -> None:
    scene = random_scene(count=20)
    scene[name].view(-1)[2] = value
    index = [int(i) for i in torch.unravel_index(torch.tensor(2), scene[name].shape)]
    strided = scene | {name: torch.stack([scene[name], scene[name]], -1)[..., 0]}
    for case in (scene, strided):
        with pytest.raises(ValueError, match=re.escape(f"{name}{index} is {value}")):
            rasterization(**case, width=16, height=16)


def test_19_no_splats_none_visible_and_one_visible() -> None:
    scene = random_scene(count=5, width=9, height=7)
    background = scene["backgrounds"].view(1, 1, 1, 3).expand(1, 7, 9, 3)
    empty = {k: v[:0] if len(v) == 5 else v for k, v in scene.items()}
    hidden = scene | {"means": scene["means"] - 10}
    behind_one = scene | {"means": torch.cat([scene["means"][:1], scene["means"][1:] - 10])}
    for case, visible in ((empty, 0), (hidden, 0), (behind_one, 1)):
        image, gradients, meta = render_with_gradients(case, 9, 7)
        assert image.shape == (1, 7, 9, 3)
        assert meta["n_visible"] == [visible]
        if not visible:
            assert torch.equal(image, background)
            assert all(not g.any() for name, g in gradients.items() if name != "backgrounds")
        assert gradients["means"].shape == case["means"].shape
        assert meta["means2d"].shape == (1, len(case["means"]), 2)


def test_20_too_many_pairs_are_refused_before_allocation() -> None:
    n = 20_000
    scene = one_splat(
        means=torch.tensor([[0.0, 0, 2]]).repeat(n, 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 1e3),
        opacities=torch.full((n,), 0.5),
        colors=torch.rand(n, 1),
    )
    with pytest.raises(MemoryError, match="pairs"):
        rasterization(**scene, width=2048, height=2048)


def test_21_every_counted_pair_reaches_a_tile() -> None:
    scene = random_scene(count=5000, width=300, height=200)
    scene["opacities"] *= 0.02 / scene["opacities"].max()
    scene["opacities"] += 0.003
    scene["scales"] *= 0.5
    meta = rasterization(**scene, width=300, height=200)[2]
    assert meta["n_pairs"][0] > 20_000
    assert meta["n_culled"][0]["occluded_pairs"] == 0
