"""Hair texture carried to the side of the head that no photo shows."""

import torch

from uika.canonical.prior import reflected_hair_detail


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
