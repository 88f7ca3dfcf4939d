"""Hair texture carried to the side of the head that no photo shows."""

import torch

from uika.canonical.prior import prior_colors, reflected_hair_detail
from uika.canonical.regions import at_texels, mask_at_texels
from uika.head import load_head, uv_texels


def ball(count: int = 6000) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return 0.1 * torch.nn.functional.normalize(points, dim=-1)


def test_far_side_gets_the_seen_texture_and_skin_gets_none() -> None:
    points = ball()
    hair = (points[:, 1] > -0.03).float()
    seen = (points[:, 2] > 0).float() * hair
    smooth = torch.full((len(points), 3), 0.4)
    stripes = 0.1 * torch.sign(torch.sin(points[:, :1] * 200))
    detail = reflected_hair_detail(points, smooth + stripes, smooth, seen, hair)
    back = (hair > 0) & (points[:, 2] < -0.02) & (points[:, 1] > 0.06)
    assert (detail[hair == 0] == 0).all()
    assert (detail[seen > 0] == 0).all()
    assert detail[back].std() > 0.05
    agreement = (torch.sign(detail[back]) == torch.sign(stripes[back])).float().mean()
    assert agreement > 0.7  # reflected front to back, stripes along x stay where they are


def test_little_hair_says_nothing() -> None:
    points = ball(300)
    smooth = torch.full((300, 3), 0.4)
    assert (reflected_hair_detail(points, smooth + 0.1, smooth, torch.ones(300), torch.ones(300)) == 0).all()


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
