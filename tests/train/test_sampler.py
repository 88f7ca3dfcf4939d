"""Which heads a step gets, the batch rule and the learning rate."""

from itertools import islice

import pytest
import torch
from safetensors.torch import load_file

from tests.recorded import PARITY, recorded
from uika.train import Sampler, SamplerConfig, batch_size, learning_rate


@recorded
def test_schedule_matches_the_released_one():
    data = load_file(PARITY / "schedule.safetensors")
    rates = [learning_rate(step, 4e-4, 30, 200) for step in range(200)]
    torch.testing.assert_close(torch.tensor(rates, dtype=torch.float64), data["out/lr"][:200], rtol=0, atol=1e-10)
    sources = range(1, 17)
    assert [batch_size(n) for n in sources] == data["out/batch_size_uika"].tolist()
    assert [batch_size(n, 48, 16) for n in sources] == data["out/batch_size_fuvt"].tolist()


def take(sampler: Sampler, steps: int):
    return list(islice(iter(sampler), steps))


def test_draws_depend_on_seed_and_step_alone():
    config = SamplerConfig(people=5, seed=3, most_sources=4, images=8)
    whole = take(Sampler(config), 12)
    assert take(Sampler(config), 12) == whole
    assert take(Sampler(SamplerConfig(people=5, seed=4, most_sources=4, images=8)), 12) != whole
    sampler, cursor = Sampler(config), 0
    for step in range(7):
        cursor = sampler.advance(step, cursor)
    assert take(Sampler(config, step=7, cursor=cursor), 5) == whole[7:]


def test_every_pass_meets_everybody_once():
    draws = [
        draw.person for batch in take(Sampler(SamplerConfig(people=7, most_sources=3, images=6)), 20) for draw in batch
    ]
    for epoch in range(len(draws) // 7):
        assert sorted(draws[7 * epoch : 7 * epoch + 7]) == list(range(7))


def test_processes_share_the_heads_of_one():
    alone = SamplerConfig(people=9, most_sources=1, images=4, most_items=4)
    half = SamplerConfig(people=9, most_sources=1, images=2, most_items=2)
    parts = [take(Sampler(half, rank, 2), 6) for rank in range(2)]
    assert [first + second for first, second in zip(*parts, strict=True)] == take(Sampler(alone), 6)


def test_sources_are_within_limits_and_agree_in_a_batch():
    batches = take(Sampler(SamplerConfig(people=9, most_sources=4, images=8, most_items=3)), 60)
    assert {draw.sources for batch in batches for draw in batch} == {1, 2, 3, 4}
    for batch in batches:
        assert len({draw.sources for draw in batch}) == 1
        assert len(batch) == min(3, 8 // batch[0].sources)


def test_nobody_to_draw_is_refused():
    with pytest.raises(ValueError, match="people"):
        Sampler(SamplerConfig(people=0))
