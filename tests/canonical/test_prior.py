"""Colours supposed for what no photo shows."""

import torch

from uika.canonical.prior import prior_colors
from uika.canonical.regions import at_texels, mask_at_texels
from uika.head import load_head, uv_texels


def test_unseen_hair_takes_the_colour_of_hair_though_forehead_is_among_what_was_seen() -> None:
    head, size = load_head(), 128
    binding = uv_texels(head, size)
    points = at_texels(head, binding, head.template)
    skin, hair = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.2, 0.15, 0.1])
    scalp = mask_at_texels(head, binding, "scalp") > 0.5
    # 45 of 100 seen places of the scalp show skin between strands of hair.
    thin = torch.rand(len(head.template), generator=torch.Generator().manual_seed(0)) < 0.45
    bare = at_texels(head, binding, thin.float()[:, None])[:, 0] > 0.5
    color = torch.where((scalp & ~bare)[:, None], hair, skin)
    known = (points[:, 2] > 0.0).float()
    offset = torch.zeros_like(head.template)
    maps = binding.to_map(color), binding.to_map(known[:, None])[0]
    supposed = binding.from_map(prior_colors(head, binding, offset, *maps, brightness=1.0))
    back = scalp & (points[:, 2] < -0.11) & (points[:, 1] > 0.03) & (points[:, 0].abs() < 0.04)
    assert (supposed[back].mean(0) - hair).abs().max() < 0.12


def test_ears_that_hair_does_not_cover_are_skin_all_round() -> None:
    head, size = load_head().without_bust, 128
    binding = uv_texels(head, size)
    points = at_texels(head, binding, head.template)
    skin, hair = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.2, 0.15, 0.1])
    scalp, ears = (mask_at_texels(head, binding, name) for name in ("scalp", "ears"))
    color = torch.where((scalp > 0.5)[:, None], hair, skin)
    known = (points[:, 2] > 0.0).float()
    maps = binding.to_map(color), binding.to_map(known[:, None])[0]
    # Hair over an ear blends into the cheek before it.
    for lift, wanted, apart in ((0.0, skin, 0.12), (0.03, hair, 0.2)):
        grown = torch.maximum(head.masks["scalp"], head.masks["ears"])[:, None]
        offset = lift * grown * torch.nn.functional.normalize(head.template, dim=-1)
        supposed = binding.from_map(prior_colors(head, binding, offset, *maps, brightness=1.0))
        assert (supposed[ears > 0.95].median(0).values - wanted).abs().max() < apart
