"""What weights may change that are worth something for the colours of the face alone."""

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch

from uika.assets import TINY_WEIGHTS
from uika.model import ModelConfig, Reconstructor, build, load_checkpoint

Make = Callable[..., dict[str, Any]]


@torch.no_grad()
def test_off_the_face_the_surface_keeps_its_observation(
    small: ModelConfig, make_inputs: Make, perturb: Callable[[Reconstructor], Reconstructor]
) -> None:
    inputs = make_inputs()
    surface, texel = inputs["surface"], inputs["texel"]
    whole = perturb(build(small)).eval()(**inputs)
    kept = perturb(build(dataclasses.replace(small, scope="face_colors"))).eval()(**inputs)
    assert torch.equal(kept.means, surface.points)
    assert torch.equal(kept.quats, surface.quats)
    assert torch.equal(kept.scales, surface.scales)
    assert bool((kept.opacities == small.gaussians.init_opacity).all())
    face = surface.face.flatten()[texel][None, :, None]
    seen = kept.aggregate.flatten(2)[:, :, texel].mT
    assert (whole.means - kept.means).abs().max() > 1e-4
    torch.testing.assert_close(kept.colors, seen + face * (whole.colors - seen), rtol=0, atol=1e-6)
    assert bool((kept.fusion_weight[face[..., 0] == 0] == 0).all())


@torch.no_grad()
def test_what_photos_show_keeps_its_colour(
    small: ModelConfig, make_inputs: Make, perturb: Callable[[Reconstructor], Reconstructor]
) -> None:
    inputs = make_inputs()
    texel = inputs["texel"]
    eyes = torch.zeros(48, 48, dtype=torch.int64)
    eyes[30:, 20:] = 1
    inputs["surface"] = surface = dataclasses.replace(
        inputs["surface"], regions=eyes, face=inputs["surface"].face.flip(2)
    )
    trusting = dataclasses.replace(small, gaussians=dataclasses.replace(small.gaussians, fusion_bias=1.0))
    whole = perturb(build(trusting)).eval()(**inputs)
    kept = perturb(build(dataclasses.replace(trusting, scope="unseen_colors"))).eval()(**inputs)
    assert torch.equal(kept.means, surface.points)
    assert bool((kept.opacities == small.gaussians.init_opacity).all())
    known = kept.known.flatten(2)[:, :, texel].mT
    seen = kept.aggregate.flatten(2)[:, :, texel].mT
    share = 0.5 * (1 - known / 0.1).clamp_min(0) * (1 - surface.face.flatten()[texel][None, :, None])
    share = share * (eyes.flatten()[texel] == 0)[None, :, None]
    torch.testing.assert_close(kept.colors, seen + share * (whole.colors - seen), rtol=0, atol=1e-6)
    assert bool((known == 1).any()) and bool((share == 0.5).any())
    assert torch.equal(kept.colors[known[..., 0] == 1], seen[known[..., 0] == 1])
    assert (kept.colors - seen).abs().amax() > 1e-2


def test_a_surface_that_does_not_know_its_face_is_refused(small: ModelConfig, make_inputs: Make) -> None:
    inputs = make_inputs()
    inputs["surface"] = dataclasses.replace(inputs["surface"], face=None)
    with pytest.raises(ValueError, match=r"surface\.face is missing"):
        build(dataclasses.replace(small, scope="face_colors")).eval()(**inputs)


def test_the_built_in_weights_colour_what_is_not_seen_and_nothing_else() -> None:
    assert load_checkpoint(TINY_WEIGHTS).config.scope == "unseen_colors"
