"""Skin and clothes where no photo shows them."""

import torch

from uika.canonical.clothes import continued
from uika.canonical.regions import at_texels
from uika.head import load_head, uv_texels

SKIN, CLOTH = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.1, 0.2, 0.5])


def test_clothes_and_neck_go_on_apart() -> None:
    head = load_head()
    texels, neck = uv_texels(head, 96, tile=1), uv_texels(head, 64)
    points = at_texels(head, texels, head.template)
    dressed = points[:, 1] < -0.17
    observed = torch.where(dressed[:, None], CLOTH, SKIN)
    front = (points[:, 2] > -0.06).float()
    found = continued(head, texels, observed * front[:, None], front, (neck, SKIN.expand(len(neck), 3)))
    colors = found.colors(head, texels)
    back = points[:, 2] < -0.12
    low, high = back & (points[:, 1] < -0.25), (points[:, 1] > -0.11) & (points[:, 2] < -0.05)
    assert int(low.sum()) > 100 and int(high.sum()) > 10
    assert (colors[low] - CLOTH).abs().max() < 0.1
    assert (colors[high] - SKIN).abs().max() < 0.05
    mixed = torch.minimum((colors - SKIN).norm(dim=-1), (colors - CLOTH).norm(dim=-1)) > 0.1
    assert mixed[back].float().mean() < 0.08  # a collar's edge, no slope from one to the other


def test_without_clothes_seen_there_is_skin_alone() -> None:
    head = load_head()
    texels, neck = uv_texels(head, 64, tile=1), uv_texels(head, 64)
    found = continued(
        head, texels, torch.zeros(len(texels), 3), torch.zeros(len(texels)), (neck, SKIN.expand(len(neck), 3))
    )
    assert (found.colors(head, texels) - SKIN).abs().max() < 0.02
