"""Avatars under other lights."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.avatars import painted_avatar
from uika.avatar import Avatar
from uika.avatar.avatar import AvatarError
from uika.avatar.relighting import relit, splat_normals, studio_light
from uika.head import load_head
from uika.head.light import COUNT, harmonics, to_linear


def lit_avatar() -> Avatar:
    light = torch.zeros(COUNT, 3)
    light[0] = 1 / harmonics(torch.tensor([0.0, 0.0, 1.0]))[0]
    avatar = painted_avatar(load_head())
    return replace(avatar, colors=torch.full_like(avatar.colors, 0.5), light=light)


def test_its_own_light_changes_nothing() -> None:
    avatar = lit_avatar()
    same = relit(avatar, load_head(), avatar.light)  # type: ignore[arg-type]
    torch.testing.assert_close(same.colors, avatar.colors, atol=1e-4, rtol=0)


def test_the_studio_lights_the_right_side_more_and_keeps_the_exposure() -> None:
    avatar, head = lit_avatar(), load_head()
    result = relit(avatar, head, studio_light())
    normals = splat_normals(avatar, head)
    level = to_linear(result.colors).mean(-1)
    assert level[normals[:, 0] < -0.6].mean() > 1.3 * level[normals[:, 0] > 0.6].mean()
    front = normals[:, 2].clamp_min(0)
    before = to_linear(avatar.colors).mean(-1)
    assert abs(float((level * front).sum() / (before * front).sum()) - 1) < 0.03


def test_files_keep_the_light_and_older_files_have_none(tmp_path: Path) -> None:
    avatar = lit_avatar()
    avatar.save(tmp_path / "lit.avatar")
    loaded = Avatar.load(tmp_path / "lit.avatar").light
    assert loaded is not None and torch.equal(loaded, avatar.light)  # type: ignore[arg-type]
    replace(avatar, light=None).save(tmp_path / "old.avatar")
    old = Avatar.load(tmp_path / "old.avatar")
    assert old.light is None
    with pytest.raises(AvatarError, match="make it again"):
        relit(old, load_head(), studio_light())
