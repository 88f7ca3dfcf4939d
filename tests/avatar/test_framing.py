"""What a portrait's camera shows, with and without the shoulders."""

import pytest
import torch

from tests.avatars import painted_avatar, painted_bust
from uika import Avatar, HeadModel, load_head, neutral_camera
from uika.head import project, uv_texels


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def test_the_head_is_framed_as_without_bust(head: HeadModel) -> None:
    plain, whole = painted_avatar(head, 64), painted_bust(head)
    expected, found = neutral_camera(plain, 20.0), neutral_camera(whole, 20.0, frame="head")
    assert torch.equal(expected.viewmat, found.viewmat)
    assert torch.equal(neutral_camera(plain, 20.0, frame="head").viewmat, expected.viewmat)


@pytest.mark.parametrize("yaw", [0.0, 50.0, 180.0])
def test_a_portrait_shows_the_shoulders_and_ends_in_the_bust(head: HeadModel, yaw: float) -> None:
    avatar = painted_bust(head)
    camera = neutral_camera(avatar, yaw, size=200)
    pixels, _ = project(avatar.means, camera)
    assert float(pixels[:, 0].min()) > 0 and float(pixels[:, 0].max()) < 200
    assert 0 < float(pixels[:, 1].min()) < 60
    bottom = pixels[avatar.on_bust, 1].max()
    assert 200 < float(bottom) < 225


def test_the_file_tells_the_bust(head: HeadModel, tmp_path) -> None:
    avatar = painted_bust(head)
    avatar.save(tmp_path / "a.safetensors")
    read = Avatar.load(tmp_path / "a.safetensors")
    assert read.bust_triangle == avatar.bust_triangle
    assert torch.equal(read.on_bust, avatar.on_bust)
    assert int(read.on_bust.sum()) == len(uv_texels(head, 48, tile=1))


def test_an_avatar_made_before_the_bust_still_fits(head: HeadModel) -> None:
    old = painted_avatar(head.without_bust, 64)
    assert old.head_id == "builtin-1"
    old.check_head(head)
    alone, whole = old.canonical_vertices(head.without_bust), old.canonical_vertices(head)
    assert torch.equal(alone, whole[: len(alone)])
