import dataclasses
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

from uika.model import PRESETS, ModelConfig, Reconstructor, build

Make = Callable[..., dict[str, Any]]


def seen_texels(result: Any, texel: torch.Tensor, model: Reconstructor, inputs: dict[str, Any]) -> torch.Tensor:
    """Valid texels on which a pixel fell, found without the model's own report."""
    size = model.config.map_size
    cells = (inputs["pixel_uv"][0, 0] * size).floor().long()
    hit = torch.zeros(size * size, dtype=torch.bool)
    hit[(cells[1] * size + cells[0]).flatten()] = True
    return hit[texel]


@pytest.mark.parametrize("views", [1, 2, 4])
def test_untrained_model_is_the_surface_wearing_the_photo(small: ModelConfig, make_inputs: Make, views: int) -> None:
    model, inputs = build(small).eval(), make_inputs(views)
    with torch.no_grad():
        result = model(**inputs)
    surface, texel = inputs["surface"], inputs["texel"]
    assert bool((result.offsets == 0).all())
    assert torch.equal(result.means, surface.points)
    torch.testing.assert_close(result.quats, surface.quats)
    torch.testing.assert_close(result.scales, surface.scales)
    torch.testing.assert_close(result.opacities, torch.full((1, len(texel)), 0.95))
    observed = result.aggregate.flatten(2)[:, :, texel].transpose(1, 2)
    torch.testing.assert_close(result.colors, observed, rtol=0, atol=4e-4)
    assert result.report["views"] == views
    assert 0 < result.report["empty_texels"] < result.report["texels"]
    assert result.report["empty_views"] == 0


def test_seen_texels_carry_the_photo_colour_and_unseen_ones_the_mirrored(small: ModelConfig, make_inputs: Make) -> None:
    model, inputs = build(small).eval(), make_inputs(1, side=96)
    inputs["images"][:] = torch.tensor([0.9, 0.4, 0.1])[:, None, None]
    with torch.no_grad():
        result = model(**inputs)
    seen = seen_texels(result, inputs["texel"], model, inputs)
    assert 0.5 < seen.float().mean() < 0.9
    expected = torch.tensor([0.9, 0.4, 0.1]).expand(1, len(seen), 3)
    torch.testing.assert_close(result.colors, expected, rtol=0, atol=1e-3)


def test_scales_are_clipped(small: ModelConfig, make_inputs: Make) -> None:
    inputs = make_inputs()
    inputs["surface"] = dataclasses.replace(inputs["surface"], scales=inputs["surface"].scales + 1.0)
    with torch.no_grad():
        result = build(small).eval()(**inputs)
    assert result.scales.max().item() == pytest.approx(0.01)


def test_absolute_start_of_the_paper(small: ModelConfig, make_inputs: Make) -> None:
    paper = PRESETS["paper"]
    config = dataclasses.replace(small, uv=paper.uv, gaussians=paper.gaussians)
    with torch.no_grad():
        result = build(config).eval()(**make_inputs())
    torch.testing.assert_close(result.scales, torch.full_like(result.scales, 0.006737947))
    torch.testing.assert_close(result.opacities, torch.full_like(result.opacities, 0.1))
    torch.testing.assert_close(result.quats[0, 0], torch.tensor([1.0, 0.0, 0.0, 0.0]))
    assert bool((result.offsets == 0).all())
    assert result.report["completed_texels"] == 0


def test_order_of_views_does_not_matter(
    small: ModelConfig, make_inputs: Make, perturb: Callable[[Reconstructor], Reconstructor]
) -> None:
    model, inputs = perturb(build(small)).eval(), make_inputs(4)
    shuffled = dict(inputs)
    for name in ("images", "masks", "pixel_uv"):
        shuffled[name] = inputs[name][:, [3, 1, 0, 2]]
    with torch.no_grad():
        first, second = model(**inputs), model(**shuffled)
    for name in ("means", "quats", "scales", "opacities", "colors", "fusion_weight"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=0, atol=1e-5)
    assert first.offsets.abs().max() > 1e-4


def test_a_batch_equals_its_items(
    small: ModelConfig, make_inputs: Make, perturb: Callable[[Reconstructor], Reconstructor]
) -> None:
    model, inputs = perturb(build(small)).eval(), make_inputs(2, batch=2)
    with torch.no_grad():
        both = model(**inputs)
        second = model(
            **{name: value[1:] if name in ("images", "masks", "pixel_uv") else value for name, value in inputs.items()}
        )
    torch.testing.assert_close(both.colors[1:], second.colors, rtol=0, atol=1e-5)
    torch.testing.assert_close(both.means[1:], second.means, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "change", [{}, {"uv_attention": False}, {"aggregation": False}, {"fusion": "fixed"}], ids=lambda c: str(c) or "full"
)
def test_gradient_reaches_every_parameter(
    small: ModelConfig,
    make_inputs: Make,
    perturb: Callable[[Reconstructor], Reconstructor],
    change: dict[str, Any],
) -> None:
    # A scale at its least passes no gradient on.
    gaussians = dataclasses.replace(small.gaussians, least_scale=0.0)
    model = perturb(build(dataclasses.replace(small, gaussians=gaussians, **change)))
    result = model(**make_inputs(2))
    generator = torch.Generator().manual_seed(0)
    loss = torch.zeros(())
    for name in ("means", "quats", "scales", "opacities", "colors"):
        value = getattr(result, name)
        loss = loss + (value * torch.randn(value.shape, generator=generator)).sum()
    loss.backward()
    silent = [n for n, p in model.named_parameters() if p.grad is None or not bool((p.grad != 0).any())]
    assert silent == []


def test_ablations_change_what_they_name(
    small: ModelConfig, make_inputs: Make, perturb: Callable[[Reconstructor], Reconstructor]
) -> None:
    inputs = make_inputs(2)
    screen_only = build(dataclasses.replace(small, uv_attention=False))
    assert not any(
        "2." in n.replace("fc2.", "").replace("norm2.", "") and "attn2" in n for n in screen_only.state_dict()
    )
    fixed = perturb(build(dataclasses.replace(small, fusion="fixed"))).eval()
    blind = perturb(build(dataclasses.replace(small, aggregation=False))).eval()
    with torch.no_grad():
        half = fixed(**inputs)
        unaided = blind(**inputs)
    confidence = half.confidence.flatten(1)[:, inputs["texel"]]
    torch.testing.assert_close(half.fusion_weight, 0.5 * confidence)
    assert bool((unaided.fusion_weight == 1).all())


def test_bad_correspondence_still_gives_a_finite_avatar(small: ModelConfig, make_inputs: Make) -> None:
    inputs = make_inputs(2)
    inputs["pixel_uv"][:, 0] = float("nan")
    with torch.no_grad():
        result = build(small).eval()(**inputs)
    assert result.report["empty_views"] == 1
    inputs["masks"][:] = 0
    with torch.no_grad():
        nothing = build(small).eval()(**inputs)
    assert nothing.report["empty_views"] == 2
    assert nothing.report["empty_texels"] == len(inputs["texel"])
    for value in (result.colors, nothing.colors, nothing.means):
        assert bool(torch.isfinite(value).all())


def test_low_trust_gives_way_to_the_mirrored_side(small: ModelConfig, make_inputs: Make) -> None:
    inputs = make_inputs(1, side=96)
    inputs["pixel_uv"][:, :, 0] /= 0.66
    inputs["images"][:] = 0.3
    inputs["images"][..., :10] = 1.0
    inputs["pixel_weight"] = torch.ones_like(inputs["masks"])
    inputs["pixel_weight"][..., :10] = 1e-3
    with torch.no_grad():
        result = build(small).eval()(**inputs)
    assert result.colors.max() < 0.35


def test_bad_arguments_are_named(small: ModelConfig, make_inputs: Make) -> None:
    model, inputs = build(small).eval(), make_inputs()
    surface = inputs["surface"]
    cases = [
        ("images must be", {"images": inputs["images"][0]}),
        ("NaN or infinite", {"images": inputs["images"] * float("nan")}),
        ("texel must be int64", {"texel": inputs["texel"].float()}),
        ("48x48 texels", {"texel": inputs["texel"] + 2000}),
        ("surface.scales must be", {"surface": dataclasses.replace(surface, scales=surface.scales[:, 1:])}),
        ("masks must be", {"masks": inputs["masks"][:, :, 0]}),
    ]
    for message, change in cases:
        with pytest.raises(ValueError, match=message):
            model(**{**inputs, **change})


def test_tiny_fits_its_budget() -> None:
    model = build("tiny")
    assert sum(p.numel() for p in model.parameters()) < 10_000_000


@pytest.mark.usefixtures("one_thread")
def test_tiny_answers_fast(make_inputs: Make) -> None:
    model, inputs = build("tiny").eval(), make_inputs(1, side=512, map_size=384)
    times = []
    for _ in range(3):
        start = time.process_time()
        with torch.no_grad():
            model(**inputs)
        times.append(time.process_time() - start)
    assert min(times) < 2.5  # processor seconds of one core


def test_a_model_that_reads_the_surface_needs_it_and_uses_it(small: ModelConfig, make_inputs: Make, perturb) -> None:
    model = perturb(build(dataclasses.replace(small, surface=True)))
    inputs = make_inputs(views=1, map_size=small.map_size)
    first = model(**inputs)
    whole = inputs["surface"]
    for name in ("lift", "shape"):
        inputs["surface"] = dataclasses.replace(whole, **{name: getattr(whole, name) + 0.05})
        assert (model(**inputs).means - first.means).abs().max() > 1e-6
        inputs["surface"] = dataclasses.replace(whole, **{name: None})
        with pytest.raises(ValueError, match=rf"surface\.{name}"):
            model(**inputs)
