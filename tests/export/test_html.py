"""The exported page in a browser."""

import base64
import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.avatars import painted_avatar
from tests.chromium import page
from tests.heads import sphere_head
from uika import HeadModel, Motion, UikaError, get_motion, load_head, neutral_camera, render
from uika.export import html_provenance, write_html
from uika.metrics import psnr

SIZE = 256


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def motion(head: HeadModel) -> Motion:
    talk = get_motion("talk", head)
    turned = torch.linspace(0, 1, len(talk))[:, None] * torch.tensor([[0.2, 0.9, -0.3]])
    return Motion(**{**talk.tensors(), "rotation": turned}, fps=talk.fps)


def test_page_plays_turns_and_shows_what_the_rasterizer_shows(head, motion, tmp_path):
    plain = painted_avatar(head, 96)
    # Smooth colours: which of two equally deep Gaussians comes first is nobody's promise.
    avatar = dataclasses.replace(plain, colors=0.5 + 0.4 * torch.sin(60 * plain.means))
    path = tmp_path / "a.html"
    size = write_html(path, avatar, motion, head)
    assert size == path.stat().st_size < 5e6
    with page(tmp_path) as tab:
        tab.open(path.as_uri())
        tab.wait("!!window.avatar")
        first = tab.run("avatar.state.frame")
        tab.wait(f"avatar.state.frame !== {first}")  # it plays by itself
        for frame, yaw, pitch in ((0, 0.0, 0.0), (30, 0.0, 10.0), (80, 35.0, -10.0)):
            url = tab.run(f"avatar.show({SIZE}, {SIZE}, {{frame: {frame}, yaw: {yaw}, pitch: {pitch}}})")
            with Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))) as file:
                picture = torch.from_numpy(np.array(file.convert("RGB"))) / 255
            params = motion.parameters(avatar.identity)[frame]
            truth = render(avatar, params, neutral_camera(avatar, yaw, pitch, SIZE), head).rgb.clamp(0, 1)
            found, worst = psnr(picture, truth), float((picture - truth).abs().max())
            print(f"frame {frame}, yaw {yaw:g}: {found:.1f} dB, largest difference {worst:.3f}")
            assert found > 42 and worst < 0.25
        tab.call("Input.dispatchMouseEvent", type="mousePressed", x=300, y=300, button="left", buttons=1)
        tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=360, y=300, button="left", buttons=1)
        tab.call("Input.dispatchMouseEvent", type="mouseReleased", x=360, y=300, button="left")
        assert tab.run("avatar.state.yaw") < 35
        tab.run("document.querySelector('summary').click()")
        assert "ünïcode" in tab.run("document.getElementById('about').innerText")
        assert tab.problems == []
        assert {url.split(":")[0] for url in tab.requests} <= {"file", "data", "blob"}


def test_page_cannot_be_broken_by_provenance(tmp_path):
    small = sphere_head()
    avatar = painted_avatar(small, 32)
    evil = "</script><script>alert(1)</script><!-- @@DATA@@"
    object.__setattr__(avatar, "provenance", {"note": evil})
    write_html(tmp_path / "a.html", avatar, get_motion("orbit", small), small)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text and text.count("<script") == 3
    assert html_provenance(tmp_path / "a.html") == {"note": evil}
    assert re.search(r"(src|href)=\"(?!data:)", text) is None and "http" not in text.replace("http-equiv", "")


def test_other_pages_have_no_provenance(tmp_path: Path):
    (tmp_path / "b.html").write_text("<p>hello</p>")
    assert html_provenance(tmp_path / "b.html") == {}
    with pytest.raises(UikaError, match="none"):
        html_provenance(tmp_path / "none.html")
