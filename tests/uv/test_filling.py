import time

import pytest
import torch

from uika.uv import fill


def horizontal_mirror(size: int) -> torch.Tensor:
    return torch.arange(size * size).reshape(size, size).flip(1)


def ramp(size: int) -> torch.Tensor:
    """A left-right symmetric, smooth picture."""
    x = (torch.arange(size) + 0.5) / size - 0.5
    y = (torch.arange(size) + 0.5) / size
    red = x.abs().expand(size, size)
    return torch.stack([red, y[:, None].expand(size, size), red + 0.3])[None]


def test_seen_texels_are_untouched_and_everything_is_finite() -> None:
    rgb = torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(1))
    seen = (torch.rand(2, 1, 48, 48, generator=torch.Generator().manual_seed(2)) > 0.5).float()
    valid = torch.ones(48, 48, dtype=torch.bool)
    result = fill(rgb, seen, valid, horizontal_mirror(48))
    keep = seen.expand_as(rgb) > 0
    assert torch.equal(result[keep], rgb[keep])
    assert bool(torch.isfinite(result).all())
    assert result.min() >= 0 and result.max() <= 1


def test_mirrored_colour_fills_the_unseen_half() -> None:
    truth = ramp(64)
    seen = torch.zeros(1, 1, 64, 64)
    seen[..., :40] = 1
    valid = torch.ones(64, 64, dtype=torch.bool)
    result = fill(truth * seen, seen, valid, horizontal_mirror(64))
    assert (result - truth).abs().max() < 0.02
    without = fill(truth * seen, seen, valid)
    assert (without - truth).abs().max() > 0.1


def test_mirrored_colour_takes_over_the_light_of_its_side() -> None:
    truth = ramp(64)
    truth = 0.8 * truth
    truth[..., 32:] += 0.1
    seen = torch.zeros(1, 1, 64, 64)
    seen[..., :48] = 1
    result = fill(truth * seen, seen, torch.ones(64, 64, dtype=torch.bool), horizontal_mirror(64))
    assert (result - truth)[..., 48:].abs().max() < 0.03


def test_background_never_bleeds_in() -> None:
    rgb = torch.full((1, 3, 64, 64), 0.8)
    valid = torch.zeros(64, 64, dtype=torch.bool)
    valid[8:28, 8:56] = True
    valid[36:56, 8:56] = True
    rgb[:, :, ~valid] = 0.0
    seen = torch.ones(1, 1, 64, 64)
    seen[..., 20:44, 20:44] = 0
    result = fill(rgb, seen, valid)
    torch.testing.assert_close(result, torch.full_like(rgb, 0.8))


def test_diffusion_is_smooth_and_stays_between_its_neighbours() -> None:
    rgb = torch.zeros(1, 3, 96, 96)
    rgb[..., :10], rgb[..., -10:] = 0.2, 0.8
    seen = torch.zeros(1, 1, 96, 96)
    seen[..., :10], seen[..., -10:] = 1, 1
    result = fill(rgb, seen, torch.ones(96, 96, dtype=torch.bool))
    assert result.min() >= 0.2 - 1e-6 and result.max() <= 0.8 + 1e-6
    assert result.diff(dim=3).abs().max() < 0.1


def test_nothing_seen_gives_the_default() -> None:
    result = fill(
        torch.zeros(1, 3, 24, 24),
        torch.zeros(1, 1, 24, 24),
        torch.ones(24, 24, dtype=torch.bool),
        horizontal_mirror(24),
        default=(0.1, 0.2, 0.3),
    )
    expected = torch.tensor([0.1, 0.2, 0.3])[None, :, None, None].expand(1, 3, 24, 24)
    torch.testing.assert_close(result, expected)


def test_confidence_blends_softly() -> None:
    rgb = torch.full((1, 3, 32, 32), 0.5)
    rgb[..., 16, 16] = 1.0
    confidence = torch.ones(1, 1, 32, 32)
    confidence[..., 16, 16] = 0.25
    value = fill(rgb, confidence, torch.ones(32, 32, dtype=torch.bool))[0, 0, 16, 16].item()
    assert 0.55 < value < 0.85


def test_mirror_of_minus_one_is_not_used() -> None:
    rgb = torch.zeros(1, 3, 32, 32)
    rgb[..., :16] = 1.0
    seen = torch.zeros(1, 1, 32, 32)
    seen[..., :16] = 1
    valid = torch.ones(32, 32, dtype=torch.bool)
    result = fill(rgb, seen, valid, torch.full((32, 32), -1))
    torch.testing.assert_close(result, fill(rgb, seen, valid))


def test_diffusion_stays_in_its_region() -> None:
    rgb = torch.zeros(1, 3, 40, 40)
    rgb[..., 4, 4], rgb[..., 30, 30] = 0.2, 0.9
    seen = (rgb[:, :1] > 0).float()
    regions = torch.zeros(40, 40, dtype=torch.int64)
    regions[20:] = 5
    valid = torch.ones(40, 40, dtype=torch.bool)
    valid[19:21] = False
    result = fill(rgb, seen, valid, regions=regions)
    torch.testing.assert_close(result[..., :19, :], torch.full((1, 3, 19, 40), 0.2))
    torch.testing.assert_close(result[..., 21:, :], torch.full((1, 3, 19, 40), 0.9))


def test_unseen_region_gets_the_default_or_the_prior() -> None:
    rgb, seen = torch.full((1, 3, 24, 24), 0.3), torch.ones(1, 1, 24, 24)
    seen[..., 12:, :] = 0
    regions = torch.zeros(24, 24, dtype=torch.int64)
    regions[12:] = 1
    prior = torch.full((3, 24, 24), float("nan"))
    prior[:, :, :12] = 0.8
    result = fill(rgb, seen, torch.ones(24, 24, dtype=torch.bool), regions=regions, prior=prior)
    torch.testing.assert_close(result[..., :12, :], rgb[..., :12, :])
    torch.testing.assert_close(result[..., 12:, :12], torch.full((1, 3, 12, 12), 0.8))
    torch.testing.assert_close(result[..., 12:, 12:], torch.full((1, 3, 12, 12), 0.5))


def test_bad_arguments_are_named() -> None:
    rgb, confidence = torch.zeros(1, 3, 8, 8), torch.zeros(1, 1, 8, 8)
    valid = torch.ones(8, 8, dtype=torch.bool)
    with pytest.raises(ValueError, match="rgb must be"):
        fill(rgb[0], confidence, valid)
    with pytest.raises(ValueError, match="confidence must be"):
        fill(rgb, rgb, valid)
    with pytest.raises(ValueError, match="valid must be"):
        fill(rgb, confidence, valid.float())
    with pytest.raises(ValueError, match="mirror must be"):
        fill(rgb, confidence, valid, torch.zeros(4, 4, dtype=torch.int64))
    with pytest.raises(ValueError, match="regions must be"):
        fill(rgb, confidence, valid, regions=valid)
    with pytest.raises(ValueError, match="prior must be"):
        fill(rgb, confidence, valid, prior=rgb)
    with pytest.raises(ValueError, match="beyond 63"):
        fill(rgb, confidence, valid, torch.full((8, 8), 64))


@pytest.mark.usefixtures("one_thread")
def test_fill_of_a_full_atlas_is_fast() -> None:
    rgb, seen = torch.rand(1, 3, 384, 384), (torch.rand(1, 1, 384, 384) > 0.6).float()
    valid = torch.ones(384, 384, dtype=torch.bool)
    mirror = horizontal_mirror(384)
    fill(rgb, seen, valid, mirror)
    times = []
    for _ in range(5):
        start = time.process_time()
        fill(rgb, seen, valid, mirror)
        times.append(time.process_time() - start)
    assert min(times) < 0.1
