"""Eyes and mouths behind lids and lips."""

import pytest
import torch
from torch import Tensor

from uika.canonical.eyes import IRIS_RADIUS, complete_eyes
from uika.canonical.mouth import hidden_mouth
from uika.canonical.regions import EYEBALLS, MOUTH, TEETH, at_texels, regions
from uika.canonical.tint import Tone, tone
from uika.head import Binding, HeadModel, load_head, uv_texels
from uika.head.mesh_parts import tongue

BLUE, WHITE = torch.tensor([0.2, 0.35, 0.6]), torch.tensor([0.82, 0.8, 0.79])


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def binding(head: HeadModel) -> Binding:
    return uv_texels(head, 384)


def texels(head: HeadModel, binding: Binding) -> tuple[Tensor, Tensor]:
    return at_texels(head, binding, head.template), binding.from_map(regions(head, binding)[None])[:, 0]


def neutral() -> Tone:
    return tone(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, dtype=torch.bool))


def painted_eyes(head: HeadModel, points: Tensor, shift: float) -> Tensor:
    """Blue irises on white balls, `shift` metres to one side."""
    side = torch.where(points[:, :1] > 0, head.joints[3], head.joints[4])
    offset = points - side
    arc = offset.norm(dim=-1) * torch.atan2(offset[:, :2].norm(dim=-1), offset[:, 2])
    place = torch.nn.functional.normalize(offset[:, :2], dim=-1) * arc[:, None] - torch.tensor([shift, 0.0])
    return torch.where(place.norm(dim=-1, keepdim=True) < IRIS_RADIUS, BLUE, WHITE)


@pytest.mark.parametrize("shift", [0.0, 0.0015])
def test_half_an_iris_is_completed_around_its_own_middle(head: HeadModel, binding: Binding, shift: float) -> None:
    points, label = texels(head, binding)
    ball = label == EYEBALLS
    truth = painted_eyes(head, points, shift)
    lids = points[:, 1] < head.joints[3, 1] + 0.001  # the upper half is hidden
    result = complete_eyes(head, points, ball, torch.where(lids[:, None], truth, 0.0), lids.float(), 1.0, neutral())
    error = (result - truth).abs().amax(-1)[ball & ~lids]
    assert (error < 0.1).float().mean() > 0.9


def test_eyes_that_were_shut_get_irises_and_white(head: HeadModel, binding: Binding) -> None:
    points, label = texels(head, binding)
    ball = label == EYEBALLS
    result = complete_eyes(head, points, ball, torch.zeros(len(points), 3), torch.zeros(len(points)), 1.0, neutral())
    level = result[ball].mean(-1)
    assert (level > 0.6).float().mean() > 0.5
    assert 0.02 < (level < 0.35).float().mean() < 0.2


def test_the_white_is_not_taken_from_the_shadow_of_the_lids(head: HeadModel, binding: Binding) -> None:
    points, label = texels(head, binding)
    ball = label == EYEBALLS
    dark = 0.35 * painted_eyes(head, points, 0.0)
    seen = (points[:, 1] < head.joints[3, 1]).float()
    result = complete_eyes(head, points, ball, dark, seen, 1.0, neutral())
    assert result[ball & (seen == 0)].mean(-1).max() > 0.55


def test_mouth_has_two_rows_a_tongue_and_a_dark_throat(head: HeadModel, binding: Binding) -> None:
    points, label = texels(head, binding)
    on_tongue = at_texels(head, binding, tongue(head)[:, None].float())[:, 0] > 0.5
    colors = hidden_mouth(head, points, label >= MOUTH, on_tongue, label == TEETH)
    level = colors.mean(-1)
    front, back = points[:, 2] > 0.045, points[:, 2] < 0.01
    assert on_tongue.any() and not (on_tongue & (label == TEETH)).any()
    assert level[(label == TEETH) & front].mean() > 0.55
    assert level[(label == MOUTH) & back].max() < 0.1
    red = colors[on_tongue & front]
    assert (red[:, 0] > 1.3 * red[:, 2]).all()


def test_black_and_white_photos_have_no_red_mouth() -> None:
    grey = torch.rand(2000, 1, generator=torch.Generator().manual_seed(1)).expand(-1, 3)
    everywhere = torch.ones(2000)
    shown = tone(grey, everywhere, everywhere > 0)
    red = shown.apply(torch.tensor([0.6, 0.2, 0.2]))
    assert float(red.max() - red.min()) < 1e-3
    sepia = grey * torch.tensor([1.0, 0.85, 0.6]) * 0.9
    white = tone(sepia, everywhere, everywhere > 0).apply(torch.tensor([0.75, 0.75, 0.75]))
    torch.testing.assert_close(white / white[0], torch.tensor([1.0, 0.85, 0.6]), atol=0.05, rtol=0)


def test_coloured_photos_keep_the_mouth_red() -> None:
    noise = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1)) * 0.3
    skin = torch.tensor([0.7, 0.5, 0.42]) + noise - 0.15
    everywhere = torch.ones(2000)
    red = tone(skin, everywhere, everywhere > 0).apply(torch.tensor([0.6, 0.25, 0.25]))
    assert float(red[0] - red[1]) > 0.25
