"""The light of pictures, by name, file or photo."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.avatars import painted_avatar
from uika.cli.lighting import under_light
from uika.errors import UikaError
from uika.head import load_head
from uika.head.light import from_environment


def test_a_light_is_a_name_or_a_picture(tmp_path: Path) -> None:
    head = load_head()
    avatar = replace(painted_avatar(head), light=from_environment(torch.ones(8, 16, 3)))
    assert under_light(avatar, head, None, None) is avatar
    studio = under_light(avatar, head, "studio", None)
    assert (studio.colors - avatar.colors).abs().max() > 0.05
    lamp = bytearray(8 * 16 * 4)
    for row in range(1, 4):
        for column in range(2, 6):
            lamp[4 * (16 * row + column) : 4 * (16 * row + column) + 4] = (200, 200, 200, 133)
    path = tmp_path / "lamp.hdr"
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n" + bytes(lamp))
    lit = under_light(avatar, head, str(path), None)
    assert torch.isfinite(lit.colors).all()
    assert (lit.colors - studio.colors).abs().max() > 0.05


def test_what_cannot_be_a_light_is_refused(tmp_path: Path) -> None:
    head = load_head()
    avatar = painted_avatar(head)
    with pytest.raises(UikaError, match="not both"):
        under_light(avatar, head, "studio", tmp_path / "photo.jpg")
    with pytest.raises(UikaError, match="'studio' or a Radiance picture"):
        under_light(avatar, head, "sunny", None)
    with pytest.raises(UikaError, match="no such file"):
        under_light(avatar, head, str(tmp_path / "none.hdr"), None)
