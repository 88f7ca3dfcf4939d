import pytest
import torch

from uika.uv import accumulate, aggregate, close_gaps, close_holes, reproject


def identity_uv(size: int) -> torch.Tensor:
    centers = (torch.arange(size) + 0.5) / size
    return torch.stack([centers.expand(size, size), centers[:, None].expand(size, size)])[None, None]


def random_views(views: int = 3, side: int = 24, batch: int = 2) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return {
        "images": torch.rand(batch, views, 3, side, side, generator=generator),
        "uv": torch.rand(batch, views, 2, side, side, generator=generator),
        "masks": (torch.rand(batch, views, 1, side, side, generator=generator) > 0.3).float(),
    }


def test_identity_map_returns_the_image() -> None:
    image = torch.rand(1, 1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    colors, weight = reproject(image, identity_uv(16), torch.ones(1, 1, 1, 16, 16), 16)
    torch.testing.assert_close(colors, image)
    assert bool((weight == 1).all())


def test_texel_is_the_mean_of_its_pixels_and_empty_texels_are_black() -> None:
    image = torch.tensor([0.2, 0.6, 1.0, 0.4]).reshape(1, 1, 1, 1, 4).expand(1, 1, 3, 1, 4)
    uv = torch.tensor([[[0.1, 0.1, 0.1, 0.9]], [[0.1, 0.1, 0.1, 0.1]]])[None, None]
    mask = torch.tensor([1.0, 1.0, 0.0, 1.0]).reshape(1, 1, 1, 1, 4)
    colors, weight = reproject(image, uv, mask, 2)
    torch.testing.assert_close(colors[0, 0, 0], torch.tensor([[0.4, 0.4], [0.0, 0.0]]))
    assert weight[0, 0, 0].tolist() == [[2.0, 1.0], [0.0, 0.0]]


def test_weights_decide_between_pixels_of_one_texel() -> None:
    image = torch.tensor([0.0, 1.0]).reshape(1, 1, 1, 1, 2).expand(1, 1, 3, 1, 2)
    uv = torch.full((1, 1, 2, 1, 2), 0.5)
    weights = torch.tensor([1.0, 3.0]).reshape(1, 1, 1, 1, 2)
    result = aggregate(image, uv, torch.ones(1, 1, 1, 1, 2), 1, weights=weights)
    assert result.rgb[0, 0].item() == pytest.approx(0.75)
    assert result.hits.item() == pytest.approx(4.0)
    assert result.trust.item() == pytest.approx(2.0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -0.01, 1.01])
def test_bad_correspondence_is_ignored(bad: float) -> None:
    data = random_views(1, 8, 1)
    data["masks"][:] = 1
    expected = data["masks"].clone()
    expected[..., 2, 5] = 0
    without = aggregate(data["images"], data["uv"], expected, 8)
    data["uv"][..., 0, 2, 5] = bad
    result = aggregate(**data, size=8)
    torch.testing.assert_close(result.rgb, without.rgb)
    torch.testing.assert_close(result.hits, without.hits)


def test_nan_colour_is_ignored() -> None:
    data = random_views(1, 8, 1)
    data["images"][..., 1, 1] = float("nan")
    assert bool(torch.isfinite(aggregate(**data, size=4).rgb).all())


def test_uv_one_falls_on_the_last_texel() -> None:
    result = aggregate(torch.ones(1, 1, 3, 1, 1), torch.ones(1, 1, 2, 1, 1), torch.ones(1, 1, 1, 1, 1), 4)
    assert result.hits[0, 0, 3, 3].item() == 1


@pytest.mark.parametrize("normalization", ["minmax", "max"])
def test_empty_masks_give_zeros(normalization: str) -> None:
    data = random_views()
    data["masks"][:] = 0
    result = aggregate(**data, size=12, normalization=normalization, oversample=2, close_radius=2)  # type: ignore[arg-type]
    for value in result:
        assert bool((value == 0).all())


@pytest.mark.parametrize("normalization", ["minmax", "max"])
def test_uniform_counts_have_full_confidence(normalization: str) -> None:
    image = torch.rand(1, 1, 3, 8, 8)
    result = aggregate(image, identity_uv(8), torch.ones(1, 1, 1, 8, 8), 8, normalization=normalization)  # type: ignore[arg-type]
    assert bool((result.confidence == 1).all())


def test_minmax_confidence_follows_the_log_of_the_count() -> None:
    uv = torch.tensor([0.1, 0.1, 0.1, 0.6]).reshape(1, 1, 1, 1, 4).expand(1, 1, 2, 1, 4).clone()
    uv[:, :, 1] = 0.1
    result = aggregate(torch.rand(1, 1, 3, 1, 4), uv, torch.ones(1, 1, 1, 1, 4), 2)
    expected = torch.tensor([[1.0, 0.5], [0.0, 0.0]])  # log(1 + 3), log(1 + 1), log(1)
    torch.testing.assert_close(result.confidence[0, 0], expected)


@pytest.mark.parametrize("oversample", [1, 2])
def test_order_of_views_and_pixels_does_not_matter(oversample: int) -> None:
    data = random_views(4)
    first = aggregate(**data, size=12, oversample=oversample, close_radius=1)
    shuffled = {name: value[:, [2, 0, 3, 1]] for name, value in data.items()}
    second = aggregate(**shuffled, size=12, oversample=oversample, close_radius=1)
    for one, other in zip(first, second, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


def test_pooled_aggregate_weighs_pixels_not_views() -> None:
    images = torch.cat([torch.zeros(1, 1, 3, 1, 4), torch.ones(1, 1, 3, 1, 4)], dim=1)
    masks = torch.ones(1, 2, 1, 1, 4)
    masks[0, 1, ..., 1:] = 0
    result = aggregate(images, torch.full((1, 2, 2, 1, 4), 0.5), masks, 1)
    assert result.rgb[0, 0].item() == pytest.approx(0.2)


def test_a_photo_half_as_fine_as_the_atlas_leaves_no_pinholes() -> None:
    coarse, fine = 32, 64
    image = identity_uv(coarse).repeat(1, 1, 2, 1, 1)[:, :, :3]
    mask = torch.ones(1, 1, 1, coarse, coarse)
    plain = aggregate(image, identity_uv(coarse), mask, fine)
    assert (plain.hits == 0).float().mean() > 0.7
    dense = aggregate(image, identity_uv(coarse), mask, fine, oversample=2, close_radius=1)
    assert bool((dense.hits > 0).all())
    # The image holds its own (u, v): what arrives must lie within the texel it arrived on.
    truth = identity_uv(fine)[:, 0]
    assert (dense.rgb[:, :2] - truth).abs()[..., 2:-2, 2:-2].max() < 1.01 / fine


def test_oversampling_does_not_bridge_charts() -> None:
    uv = identity_uv(16).clone()
    uv[:, :, 0, :, 8:] += 0.3
    uv[:, :, 0] *= 0.7
    sums = accumulate(torch.rand(1, 1, 3, 16, 16), uv, torch.ones(1, 1, 1, 16, 16), 200, oversample=3)
    gap = sums.samples[0, 0, 0, :, int(0.7 * 200 * 0.52) : int(0.7 * 200 * 0.78)]
    assert bool((gap == 0).all())


def test_closing_fills_near_holes_only_and_keeps_seen_texels() -> None:
    values = torch.zeros(1, 3, 16, 16)
    weight = torch.zeros(1, 1, 16, 16)
    values[..., 4, 4], weight[..., 4, 4] = 0.5, 2.0
    valid = torch.ones(16, 16, dtype=torch.bool)
    valid[5, 5] = False
    closed, closed_weight = close_holes(values, weight, valid, radius=2)
    inside = torch.zeros(16, 16, dtype=torch.bool)
    inside[2:7, 2:7] = True
    inside &= valid
    torch.testing.assert_close(closed[0, :, inside], torch.full((3, int(inside.sum())), 0.5))
    torch.testing.assert_close(closed_weight[0, 0][inside], torch.full((int(inside.sum()),), 2.0))
    assert bool((closed_weight[0, 0][~inside] == 0).all())
    assert bool((closed[0, :, ~inside] == 0).all())


def test_vanishing_weights_stay_finite() -> None:
    data = random_views(1, 8, 1)
    for weight in (1e-40, 1e-20):
        weights = torch.full_like(data["masks"], weight)
        for value in aggregate(**data, size=12, weights=weights, oversample=2, close_radius=2):
            assert bool(torch.isfinite(value).all())
            assert value.max() <= 1


def test_bad_arguments_are_named() -> None:
    data = random_views()
    with pytest.raises(ValueError, match="uv must be"):
        reproject(data["images"], data["uv"][:, :2], data["masks"], 8)
    with pytest.raises(ValueError, match="images must be"):
        reproject(data["images"][0], data["uv"], data["masks"], 8)
    with pytest.raises(ValueError, match="grid must be"):
        reproject(**data, size=8, grid="edges")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="counts every pixel once"):
        reproject(**data, size=8, grid="corners", oversample=2)
    with pytest.raises(ValueError, match="normalization must be"):
        aggregate(**data, size=8, normalization="mean")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="radius must be"):
        close_holes(torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4), radius=0)


def test_gaps_close_and_the_border_stays() -> None:
    rows = torch.zeros(1, 1, 24, 24)
    rows[:, :, 6:19:3, 4:20] = 0.8
    values = torch.full((1, 3, 24, 24), 0.3) * (rows > 0)
    closed, share = close_gaps(values, rows, torch.ones(24, 24, dtype=torch.bool), 3)
    inside = torch.zeros(24, 24, dtype=torch.bool)
    inside[6:19, 4:20] = True
    assert (share[0, 0][inside] > 0.79).all() and (share[0, 0][~inside] == 0).all()
    assert (closed[0, :, inside] - 0.3).abs().max() < 1e-5
    assert (closed[0, :, ~inside] == 0).all()
