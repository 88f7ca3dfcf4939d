"""The half of a face that was seen well wins over the one that was grazed."""

import torch

from uika.uv import mirror_preference

SIZE = 48


def preference(left: float, right: float) -> torch.Tensor:
    mirror = torch.arange(SIZE * SIZE).reshape(SIZE, SIZE).flip(1)
    trust = torch.full((1, 1, SIZE, SIZE), left)
    trust[..., SIZE // 2 :] = right
    return mirror_preference(trust, torch.ones(SIZE, SIZE, dtype=torch.bool), mirror)[0, 0]


def test_halves_seen_alike_are_both_kept() -> None:
    assert torch.equal(preference(0.9, 0.9), torch.ones(SIZE, SIZE))
    assert torch.equal(preference(0.5, 0.6), torch.ones(SIZE, SIZE))


def test_the_grazed_half_gives_way_to_the_near_one() -> None:
    kept = preference(0.9, 0.12)
    assert kept[:, : SIZE // 2 - 6].min() == 1
    assert kept[:, SIZE // 2 + 6 :].max() < 0.1


def test_a_half_that_was_seen_fairly_stays_though_the_other_was_seen_better() -> None:
    assert preference(1.0, 0.42)[:, SIZE // 2 + 6 :].min() == 1


def test_nothing_is_lost_where_there_is_no_other_half() -> None:
    mirror = torch.full((SIZE, SIZE), -1)
    trust = torch.rand(1, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    assert torch.equal(
        mirror_preference(trust, torch.ones(SIZE, SIZE, dtype=torch.bool), mirror), torch.ones_like(trust)
    )
