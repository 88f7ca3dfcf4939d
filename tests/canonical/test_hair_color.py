"""Colours and grain of hair that no photo shows."""

import torch
from torch import Tensor

from uika.canonical.hair_color import grain, kinds, like_first, nearby, strands, weighted_median
from uika.canonical.regions import at_texels, mask_at_texels
from uika.head import Binding, HeadModel, load_head, uv_texels

SKIN, HAIR = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.2, 0.15, 0.1])


def ball(count: int = 6000) -> Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return 0.1 * torch.nn.functional.normalize(points, dim=-1)


def texels() -> tuple[HeadModel, Binding, Tensor, Tensor]:
    head = load_head().without_bust
    binding = uv_texels(head, 128)
    return head, binding, at_texels(head, binding, head.template), mask_at_texels(head, binding, "scalp")


def test_hair_is_told_from_the_forehead_among_it() -> None:
    head, binding, points, scalp = texels()
    bare = torch.rand(len(points), generator=torch.Generator().manual_seed(1)) < 0.7
    color = torch.where(((scalp > 0.5) & ~bare)[:, None], HAIR, SKIN)
    seen = (points[:, 2] > 0).float()
    skin, hair = kinds(head, binding, points, color, seen, scalp)
    assert (skin - SKIN).abs().max() < 0.02 and (hair - HAIR).abs().max() < 0.02


def test_a_bald_head_with_a_shadow_is_skin_all_over() -> None:
    head, binding, points, scalp = texels()
    color = SKIN.expand(len(points), 3) * (0.95 + 0.05 * torch.rand(len(points), 1))
    color = torch.where((points[:, 0] > 0.075)[:, None], 0.6 * color, color)
    skin, hair = kinds(head, binding, points, color, (points[:, 2] > 0).float(), scalp)
    assert (hair - skin).abs().max() < 0.06


def test_grain_has_the_spread_of_the_seen_and_no_pattern_of_its_own() -> None:
    points = ball()
    lines = (
        0.05 * torch.randn(len(points), 1, generator=torch.Generator().manual_seed(2)) * torch.tensor([1.0, 0.8, 0.5])
    )
    seen = points[:, 2] > 0
    made = grain(points, lines, seen)
    assert torch.equal(made, grain(points, lines, seen))
    ratio = made.std(0) / lines[seen].std(0)
    assert ((ratio > 0.7) & (ratio < 1.3)).all()
    assert made.mean(0).abs().max() < 0.01
    assert (grain(points[:30], lines[:30], seen[:30]) == 0).all()


def test_strands_run_down_from_the_whorl() -> None:
    back = torch.tensor([[0.0, 0.03, -0.145]])
    step = torch.linspace(-0.003, 0.003, 200)[:, None]
    down, across = (strands(back + step * torch.tensor([axis])).std() for axis in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]))
    assert down < 0.6 * across


def test_colours_like_neither_are_no_skin() -> None:
    veil = torch.tensor([[0.72, 0.66, 0.3]])
    assert like_first(SKIN[None], SKIN, HAIR) == 1 and like_first(HAIR[None], SKIN, HAIR) == 0
    assert like_first(veil, SKIN, HAIR) == 0
    assert like_first(SKIN[None], SKIN, SKIN) == 0


def test_medians_weigh() -> None:
    values = torch.linspace(0, 1, 101)[:, None].expand(101, 3)
    assert abs(float(weighted_median(values, torch.ones(101))[0]) - 0.5) < 0.02
    assert float(weighted_median(values, 1 + 9 * (values[:, 0] > 0.8))[0]) > 0.75


def test_a_veil_goes_on_beside_what_was_seen_of_it() -> None:
    points = ball(3000)
    veil = torch.tensor([0.7, 0.65, 0.5])
    seen = ((points[:, 0] > 0.05) & (points[:, 2] > 0)).float()
    found = nearby(points, veil.expand(3000, 3), seen, HAIR)
    beside = (points[:, 0].abs() > 0.07) & (points[:, 2] < 0) & (points[:, 2] > -0.02)
    assert (found[beside] - veil).abs().max() < 0.1  # on the other side of the head too
    assert (found[points[:, 2] < -0.095] - HAIR).abs().max() < 0.1
