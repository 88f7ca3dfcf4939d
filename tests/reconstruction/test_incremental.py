from pathlib import Path

import pytest
import torch

from tests.agreement import assert_same_avatar, on_head
from uika import GrowingAvatar, HeadModel, UikaError, load_head, reconstruct
from uika.assets import PORTRAIT
from uika.avatar.framing import neutral_camera
from uika.avatar.rendering import render
from uika.head import HeadParameters
from uika.io.video import write_png
from uika.photo import PhotoError
from uika.reconstruction import Report


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def photos(head: HeadModel, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The portrait, and its avatar from both sides."""
    avatar = reconstruct([PORTRAIT], head, "none").avatar
    params = HeadParameters.zeros(head).replace(identity=avatar.identity)
    folder, paths = tmp_path_factory.mktemp("photos"), [PORTRAIT]
    for yaw in (-25.0, 25.0):
        paths.append(folder / f"{yaw:.0f}.png")
        write_png(paths[-1], render(avatar, params, neutral_camera(avatar, yaw, 0.0, 512), head).rgb)
    return paths


def test_growing_ends_where_everything_at_once_does(photos: list[Path], head: HeadModel) -> None:
    growing, whole = GrowingAvatar(head=head, photo_splats=False), reconstruct(photos, head, photo_splats=False).avatar
    first = growing.add(photos[:2])
    alone = reconstruct(photos[:2], head, photo_splats=False).avatar
    torch.testing.assert_close(first.means, alone.means, rtol=0, atol=1e-5)
    report = Report()
    grown = growing.add(photos[2:], report)
    assert len(growing) == 3
    assert report.counts["views"] == 3
    assert report.counts["reused_views"] == 2
    assert torch.equal(grown.identity, first.identity)
    assert grown.provenance == whole.provenance
    assert (on_head(grown).colors - on_head(first).colors).abs().max() > 0.05  # the new side is seen
    assert_same_avatar(growing.refresh(), whole)


def test_a_photo_that_cannot_be_used_changes_nothing(photos: list[Path], head: HeadModel, tmp_path: Path) -> None:
    growing = GrowingAvatar(head=head, keep="foreground")
    with pytest.raises(UikaError, match="no photos yet"):
        growing.refresh()
    growing.add(photos[:1])
    write_png(tmp_path / "grey.png", torch.full((64, 64, 3), 0.5))
    with pytest.raises(PhotoError, match=r"grey\.png"):
        growing.add([tmp_path / "grey.png"])
    assert len(growing) == 1
    with pytest.raises(UikaError, match="1 to 63 more photos"):
        growing.add([])


def test_the_untrained_way_grows_too(photos: list[Path], head: HeadModel) -> None:
    growing = GrowingAvatar("none", head, photo_splats=False)
    first = growing.add(photos[:1])
    assert_same_avatar(first, reconstruct(photos[:1], head, "none", photo_splats=False).avatar)
    assert (on_head(growing.add(photos[2:])).colors - on_head(first).colors).abs().max() > 0.05
    whole = reconstruct([photos[0], *photos[2:]], head, "none", photo_splats=False).avatar
    assert_same_avatar(growing.refresh(), whole)


def test_photo_splats_grow_too(photos: list[Path], head: HeadModel) -> None:
    growing, report = GrowingAvatar("none", head), Report()
    counts = []
    for each in photos[:2]:
        avatar = growing.add([each], report)
        counts.append(report.counts["photo_splats"])
        assert avatar.provenance["photo_splats"] == str(counts[-1])
        assert len(avatar) - counts[-1] > 100_000
    assert 0 < counts[0] < counts[1]
