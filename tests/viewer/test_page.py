"""The viewer in a browser."""

import dataclasses
import io
import time

import numpy as np
import pytest
import torch
from PIL import Image

from tests.avatars import painted_avatar
from tests.chromium import Page, page
from uika import UikaError, get_motion, load_head
from uika.cli import main
from uika.viewer import Viewer

pytest.importorskip("viser", reason="no viser: install the extra 'view'")


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


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
def test_jaw_slider_changes_the_picture(tmp_path):
    head = load_head()
    plain = painted_avatar(head, 96)
    avatar = dataclasses.replace(plain, colors=0.5 + 0.4 * torch.sin(80 * plain.means))
    with Viewer(avatar, head, get_motion("talk", head), 8199) as viewer:
        assert viewer.url.startswith("http://127.0.0.1:")
        with page(tmp_path, 900, 700) as tab:
            tab.open(viewer.url)
            tab.wait("document.querySelectorAll('[role=slider]').length >= 6")
            rest, sent = _settled(tab), viewer.updates
            tab.run("document.querySelector('[role=slider]').focus()")
            tab.key("End", 35)
            deadline = time.monotonic() + 30
            while viewer.updates == sent and time.monotonic() < deadline:
                tab.run("1")
                time.sleep(0.1)
            assert viewer.updates > sent
            opened = _settled(tab)
            changed = np.abs(opened - rest).sum(-1) > 60
            share = changed.mean(1)
            assert changed.mean() > 0.01
            assert share[len(share) // 2 :].sum() > 3 * share[: len(share) // 2].sum()  # the jaw, not the skull
            # three.js reports bounds that are not a number; where from is not known, and what is drawn is right.
            assert [text for text in tab.problems if "computeBoundingSphere" not in text] == []


def test_wrong_port_is_one_sentence(tmp_path, capsys):
    assert main(["view", "none.safetensors", "--port", "80"]) == 2
    assert "port" in capsys.readouterr().err
    assert main(["view", "none.safetensors"]) == 2
    assert "none.safetensors" in capsys.readouterr().err
    with pytest.raises(UikaError, match="head model"):
        from tests.heads import sphere_head

        Viewer(painted_avatar(sphere_head(), 16), load_head())
