"""The exported page in a browser."""

import base64
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.avatars import painted_avatar
from tests.chromium import page
from tests.heads import sphere_head
from tests.served import served
from uika import HeadModel, HeadParameters, Motion, UikaError, get_motion, load_head, neutral_camera, render
from uika.export import html_provenance, write_html
from uika.head import rodrigues
from uika.head.axis_angle import axis_angle
from uika.metrics import psnr
from uika.motion.presets import expression_vector

SIZE = 256


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


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
    assert size == path.stat().st_size < 6e6  # 2 MB of it are what the 52 actions do to each vertex
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


def still_of(url: str) -> torch.Tensor:
    with Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))) as file:
        return torch.from_numpy(np.array(file.convert("RGB"))) / 255


def test_page_is_driven_by_scripts_messages_files_and_sound(head, motion, tmp_path):
    plain = painted_avatar(head, 96)
    avatar = dataclasses.replace(plain, colors=0.5 + 0.4 * torch.sin(60 * plain.means))
    (tmp_path / "site").mkdir()
    write_html(tmp_path / "site" / "a.html", avatar, motion, head)
    frames = [{"jawOpen": 0.5, "headYaw": 0.2}, {"jawOpen": 0.5, "headYaw": 0.2}]
    (tmp_path / "site" / "own.json").write_text(json.dumps({"fps": 30, "frames": frames}))
    (tmp_path / "site" / "bad.json").write_text("{}}")
    frame = "<iframe id=f src=a.html width=300 height=300></iframe>"
    (tmp_path / "site" / "embed.html").write_text(f"<link rel=icon href=data:,>{frame}")
    rest = HeadParameters.zeros(head).replace(identity=avatar.identity)

    def ours(actions: dict[str, float], yaw: float, pitch: float, roll: float = 0.0) -> torch.Tensor:
        turn = [torch.tensor([-pitch, 0.0, 0.0]), torch.tensor([0.0, yaw, 0.0]), torch.tensor([0.0, 0.0, -roll])]
        x, y, z = (rodrigues(torch.deg2rad(part)) for part in turn)
        neck = torch.from_numpy(axis_angle((y @ x @ z).double().numpy())).float()
        params = rest.replace(expression=expression_vector(head, actions), neck=neck)
        return render(avatar, params, neutral_camera(avatar, 10.0, 0.0, SIZE), head).rgb.clamp(0, 1)

    shown = f"avatar.show({SIZE}, {SIZE}, {{yaw: 10, pitch: 0}})"
    with served(tmp_path / "site") as address, page(tmp_path) as tab:
        tab.open(f"{address}/a.html")
        tab.wait("!!window.avatar")
        assert set(tab.run("avatar.names")) == set(head.expression_names)
        assert tab.run("avatar.set({jawOpen: 0.6, mouthSmile: 0.5, nonsense: 1})") == ["nonsense"]
        tab.run("avatar.pose({yaw: 20, pitch: 8, roll: -6})")
        truth = ours({"jawOpen": 0.6, "mouthSmile": 0.5}, 20, 8, -6)
        found = psnr(still_of(tab.run(shown)), truth)
        other = psnr(still_of(tab.run(shown)), ours({"jawOpen": 0.6}, 20, 8, -6))
        print(f"driven: {found:.1f} dB; without the smile {other:.1f} dB")
        assert found > 38 and other < found - 6
        tab.run("avatar.set({jawOpen: 7, mouthSmile: 'x'}); avatar.pose({yaw: 0, pitch: NaN, roll: Infinity})")
        assert psnr(still_of(tab.run(shown)), ours({"jawOpen": 1.0}, 0, 0)) > 38

        tab.open(f"{address}/embed.html")
        child = "document.getElementById('f').contentWindow"
        tab.wait("!!document.getElementById('f')?.contentWindow?.avatar")
        told = "{type: 'avatar', set: {mouthPucker: 0.8}, pose: {yaw: -15}}"
        tab.run(f"{child}.postMessage({told}, '*'); {child}.postMessage('something else', '*')")
        tab.wait("document.getElementById('f').contentDocument.getElementById('play').textContent === 'Play'")
        assert psnr(still_of(tab.run(f"{child}.{shown}")), ours({"mouthPucker": 0.8}, -15, 0)) > 38

        tab.open(f"{address}/a.html?motion=own.json")
        tab.wait("!!window.avatar && avatar.driven && avatar.level('jawOpen') > 0.4")
        assert psnr(still_of(tab.run(shown)), ours({"jawOpen": 0.5}, 0.2 * 180 / np.pi, 0)) > 38
        tab.open(f"{address}/a.html?motion=bad.json")
        tab.wait("document.getElementById('message')?.textContent.startsWith('bad.json: ')")
        assert tab.problems == []
        tab.open(f"{address}/a.html?motion=none.json")
        tab.wait("document.getElementById('message')?.textContent.startsWith('none.json: 404')")

        tab.open((tmp_path / "site" / "a.html").as_uri() + "?motion=own.json")
        tab.wait("document.getElementById('message')?.textContent.includes('drop the file')")
        tab.run("avatar.motion('[{\"jawOpen\": 0.5}]')")
        tab.wait("avatar.level('jawOpen') > 0.4")
        assert psnr(still_of(tab.run(shown)), ours({"jawOpen": 0.5}, 0, 0)) > 38


def test_the_microphone_opens_the_mouth(tmp_path):
    small = sphere_head()
    avatar = painted_avatar(dataclasses.replace(small, expression_names=("jawOpen", "a", "b")), 32)
    write_html(
        tmp_path / "a.html",
        avatar,
        get_motion("orbit", small),
        dataclasses.replace(small, expression_names=("jawOpen", "a", "b")),
    )
    with page(tmp_path, flags=("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")) as tab:
        tab.open((tmp_path / "a.html").as_uri())
        tab.wait("!!window.avatar")
        assert tab.run("avatar.level('jawOpen')") == 0
        tab.run("document.getElementById('listen').click()")
        tab.wait("avatar.level('jawOpen') > 0.1", 20)  # the browser's own test sound beeps
        tab.run("avatar.quiet()")
        assert tab.run("avatar.level('jawOpen')") == 0


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
