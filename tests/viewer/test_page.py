"""The viewer in a browser."""

import dataclasses
import io
import re
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drjit_splat import load_ply
from tests.avatars import painted_avatar
from tests.chromium import Page, page
from uika import Avatar, UikaError, get_motion, load_head
from uika.cli import main
from uika.safeguards import verify
from uika.viewer import Viewer
from uika.viewer.painting import BROWSER, HERE
from uika.viewer.sending import KINDS

pytest.importorskip("viser", reason="no viser: install the extra 'view'")
pytestmark = pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
# viser draws every splat on one square whose corners have two coordinates. three.js asks for the bounds of three, finds
# none and logs this once; without bounds the square is never culled, which is right, for the shader places it.
BOUNDS = "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN."
CORNERS = "function () { return [this.attributes.position.itemSize, ...this.attributes.position.array]; }"


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    plain = painted_avatar(load_head(), 96)
    return dataclasses.replace(plain, colors=0.5 + 0.4 * torch.sin(80 * plain.means))


def _picture(tab: Page) -> np.ndarray:
    """What lies left of the controls."""
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)[150:, :550]


def _settled(tab: Page, seconds: float = 60.0) -> np.ndarray:
    """A picture with a head in it that has stopped to change."""
    deadline, last = time.monotonic() + seconds, _picture(tab)
    while time.monotonic() < deadline:
        time.sleep(1.0)
        now = _picture(tab)
        if now.min() < 100 and np.abs(now - last).mean() < 0.05:
            return now
        last = now
    raise AssertionError("the picture does not settle")


def _open(tab: Page, viewer: Viewer) -> np.ndarray:
    tab.open(viewer.url)
    tab.wait("document.querySelectorAll('[role=slider]').length >= 6")
    return _settled(tab)


def _no_errors(tab: Page, squares: int = 1) -> None:
    """Nothing was logged but that viser's square has no bounds, once for each number of splats."""
    assert [text for text in tab.problems if not text.startswith(BOUNDS)] == []
    assert len(tab.problems) <= squares
    for handle in tab.objects:
        assert tab.call_on(handle, CORNERS) == [2, -2, -2, 2, -2, 2, 2, -2, 2]


def _updated(viewer: Viewer, tab: Page, since: int) -> None:
    deadline = time.monotonic() + 30
    while viewer.updates <= since:
        assert time.monotonic() < deadline, tab.problems
        tab.run("1")
        time.sleep(0.1)


def test_jaw_slider_changes_the_picture(avatar, tmp_path):
    with Viewer(avatar, load_head(), port=8199) as viewer:
        assert viewer.url.startswith("http://127.0.0.1:")
        with page(tmp_path, 900, 700) as tab:
            rest, sent = _open(tab, viewer), viewer.updates
            tab.run("document.querySelector('[role=slider]').focus()")
            tab.key("End", 35)
            _updated(viewer, tab, sent)
            changed = np.abs(_settled(tab) - rest).sum(-1) > 60
            share = changed.mean(1)
            assert changed.mean() > 0.01
            assert share[len(share) // 2 :].sum() > 3 * share[: len(share) // 2].sum()  # the jaw, not the skull
            _no_errors(tab)


@pytest.mark.slow
def test_pictures_drawn_here_follow_the_sliders(avatar, tmp_path):
    with Viewer(avatar, load_head(), port=8199) as viewer, page(tmp_path, 900, 700) as tab:
        drawn = _open(tab, viewer)
        _choose(tab, BROWSER, HERE)
        time.sleep(1.0)
        painted = _settled(tab)
        assert np.abs(painted - drawn).mean() < 6  # the same head at the same place
        sent = viewer.updates
        tab.run("document.querySelector('[role=slider]').focus()")
        tab.key("End", 35)
        _updated(viewer, tab, sent)
        assert (np.abs(_settled(tab) - painted).sum(-1) > 60).mean() > 0.01
        _no_errors(tab, squares=2)


@pytest.mark.slow
def test_every_control_does_what_it_says(avatar, tmp_path):
    head = load_head()
    with Viewer(avatar, head, get_motion("talk", head), 8199) as viewer, page(tmp_path, 900, 700) as tab:
        folder = tmp_path / "saved"
        tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
        last = _open(tab, viewer)
        labels = tab.run("[...document.querySelectorAll('label')].map((label) => label.innerText.trim())")
        assert {"jaw", "turn", "gaze left", "mode 1", "play", "frame", *head.expression_names} <= set(labels)
        for change in (
            lambda: tab.press("Left"),
            lambda: tab.switch("mesh"),
            lambda: _choose(tab, "photo", "UV"),
        ):
            change()
            now = _settled(tab)
            assert np.abs(now - last).mean() > 0.5
            last = now
        _still(tab)
        for kind in KINDS:
            _saved(tab, kind, folder, len(avatar))
        sent = viewer.updates
        tab.switch("play")
        _updated(viewer, tab, sent + 3)
        tab.switch("play")
        _no_errors(tab)


def _choose(tab: Page, old: str, new: str) -> None:
    tab.run(f"[...document.querySelectorAll('input')].find((input) => input.value === {old!r}).click()")
    tab.press(new, "[role=option]")


def _still(tab: Page) -> None:
    """The browser's picture and the rasterizer's are alike."""
    tab.press("Render with drjit_splat")
    tab.wait("/browser against drjit_splat: [0-9.]+ dB/.test(document.body.textContent)", 90)
    found = re.search(r"drjit_splat: ([0-9.]+) dB", tab.run("document.body.textContent"))
    print(f"browser against drjit_splat: {found[1]} dB")
    assert float(found[1]) > 25


def _saved(tab: Page, kind: str, folder: Path, count: int) -> None:
    tab.press(kind)
    deadline = time.monotonic() + 60
    while not (path := folder / f"avatar{kind}").is_file():
        assert time.monotonic() < deadline, (kind, tab.problems)
        tab.run("1")
        time.sleep(0.1)
    if kind == ".ply":
        assert len(load_ply(path).means) == count
    elif kind == ".png":
        found = verify(path)
        assert found.watermark.found and found.provenance["watermark"] == "yes"
    else:
        assert path.stat().st_size > 30 * count / 2


def test_wrong_port_is_one_sentence(avatar, tmp_path, capsys):
    assert main(["view", "none.safetensors", "--port", "80"]) == 2
    assert "port" in capsys.readouterr().err
    assert main(["view", "none.safetensors"]) == 2
    assert "none.safetensors" in capsys.readouterr().err
    with pytest.raises(UikaError, match="head model"):
        from tests.heads import sphere_head

        Viewer(painted_avatar(sphere_head(), 16), load_head())
    avatar.save(tmp_path / "a.safetensors")
    assert main(["view", str(tmp_path / "a.safetensors"), "--video", "97"]) == 2
    assert "camera 97" in capsys.readouterr().err
