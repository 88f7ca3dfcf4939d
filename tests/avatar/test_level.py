"""Half as many Gaussians: what both covered stays covered, and small pictures look the same."""

import dataclasses

import pytest
import torch

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import Avatar, HeadModel, HeadParameters, get_motion, neutral_camera, render
from uika.avatar.frame_renderer import film
from uika.avatar.level import at_level, halved
from uika.metrics import psnr


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return sphere_head()


@pytest.fixture(scope="module")
def avatar(head: HeadModel) -> Avatar:
    plain = painted_avatar(head, 192)
    return dataclasses.replace(plain, colors=0.5 + 0.4 * torch.sin(40 * plain.means))


def test_the_half_looks_like_the_whole(head, avatar):
    half = halved(avatar)
    assert 0.5 <= len(half) / len(avatar) < 0.6
    for size in (64, 256):
        camera = neutral_camera(avatar, 25.0, 10.0, size)
        pictures = [render(each, HeadParameters.zeros(head), camera, head) for each in (avatar, half)]
        assert psnr(pictures[1].rgb, pictures[0].rgb) > 35
        assert (pictures[1].alpha - pictures[0].alpha).abs().mean() < 0.01


def test_it_moves_with_the_head(head, avatar):
    motion = get_motion("talk", head)
    whole, half = (next(iter(film(avatar, motion, head=head, size=128, level=level))) for level in ("full", "half"))
    assert psnr(torch.from_numpy(half).float() / 255, torch.from_numpy(whole).float() / 255) > 33


def test_what_is_unlike_or_far_apart_stays_single(avatar):
    colors = avatar.colors.clone()
    colors[::2], colors[1::2] = 0.1, 0.9
    assert len(halved(dataclasses.replace(avatar, colors=colors))) == len(avatar)
    assert len(halved(dataclasses.replace(avatar, scales=avatar.scales / 100))) == len(avatar)
    same = halved(dataclasses.replace(avatar, scales=avatar.scales / 100))
    assert all(torch.equal(getattr(same, name), getattr(avatar, name)) for name in ("means", "quats", "triangle"))


def test_one_pair_keeps_mean_colour_and_coverage(avatar):
    index = torch.tensor([0, 1])
    names = ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric")
    two = dataclasses.replace(avatar, **{name: getattr(avatar, name)[index].clone() for name in names})
    two.means[:] = torch.tensor([[0.0, 0, 0], [0.001, 0, 0]])
    two.quats[:] = torch.tensor([1.0, 0, 0, 0])
    two.scales[:] = torch.tensor([0.001, 0.001, 0.0001])
    two.opacities[:], two.colors[:] = 0.5, torch.tensor([[0.2, 0.3, 0.4], [0.3, 0.3, 0.3]])
    one = halved(two)
    assert len(one) == 1
    assert torch.allclose(one.means[0], torch.tensor([0.0005, 0, 0]), atol=1e-7)
    assert torch.allclose(one.colors[0], torch.tensor([0.25, 0.3, 0.35]), atol=1e-6)
    wide = one.scales[0].sort().values
    assert wide[1] == pytest.approx(0.001, rel=1e-4) and wide[2] == pytest.approx(0.001 * 1.5**0.5, rel=1e-4)
    assert float(one.opacities[0]) * float(wide[1] * wide[2]) == pytest.approx(2 * 0.5 * 1e-6, rel=1e-4)


def test_small_pictures_take_the_half(avatar):
    assert at_level(avatar, "auto", neutral_camera(avatar, size=512)) is avatar
    assert len(at_level(avatar, "auto", neutral_camera(avatar, size=96))) < len(avatar)
    assert at_level(avatar, "full", neutral_camera(avatar, size=32)) is avatar
