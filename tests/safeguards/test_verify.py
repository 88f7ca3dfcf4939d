import json
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import Avatar, UikaError, load_head
from uika.cli import main
from uika.head import save_head
from uika.safeguards import picture_provenance, stamped, verify
from uika.safeguards.provenance import fingerprint

NOON = datetime(2030, 1, 2, 12, tzinfo=timezone.utc)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    save_head(sphere_head(), tmp_path / "small.npz")
    monkeypatch.setenv("UIKA_HEAD", str(tmp_path / "small.npz"))
    monkeypatch.chdir(tmp_path)
    avatar = painted_avatar(load_head(), 64)
    avatar.colors.copy_(0.5 + 0.3 * torch.sin(120 * avatar.means))  # the mark needs some detail to hide in
    stamped(avatar, consent=True, time=NOON).save("a.safetensors")
    return tmp_path


def test_avatar_says_when_and_with_whose_consent(folder):
    found = verify("a.safetensors")
    assert found.watermark is None and found.found
    assert found.provenance["consent"] == "stated by the user" and found.provenance["photos"] == "none"
    assert found.provenance["time"] == "2030-01-02T12:00:00+00:00"
    again = stamped(Avatar.load("a.safetensors"), consent=False)
    assert again.provenance["consent"] == "not stated" and again.provenance["photos"] == "none"


def test_picture_provenance_names_the_avatar(folder):
    avatar = Avatar.load("a.safetensors")
    known = picture_provenance(avatar, watermark=False, time=NOON)
    assert known["watermark"] == "no" and known["avatar"] == fingerprint(avatar) and known["photos"] == "none"
    avatar.means[0, 0] += 1
    assert fingerprint(avatar) != known["avatar"]


def test_commands_mark_and_say_so(folder, capsys):
    assert main(["render", "a.safetensors", "-o", "f.png", "--size", "256"]) == 0
    found = verify("f.png")
    assert found.watermark.found and found.provenance["watermark"] == "yes" and found.provenance["photos"] == "none"
    assert main(["render", "a.safetensors", "-o", "g.png", "--size", "256", "--no-watermark"]) == 0
    found = verify("g.png")
    assert not found.watermark.found and found.provenance["watermark"] == "no"
    np.savez("m.npz", fps=10, expression=np.zeros((3, 3)))
    animate = ["animate", "a.safetensors", "--motion", "m.npz", "--size", "256"]
    assert main([*animate, "-o", "v.mp4"]) == 0 and main([*animate, "-o", "w.mp4", "--no-watermark"]) == 0
    capsys.readouterr()
    assert main(["verify", "v.mp4"]) == 0
    out = capsys.readouterr().out
    assert "watermark   found" in out and "stated by the user" in out and "3 frames looked at" in out
    assert main(["verify", "w.mp4"]) == 0  # the provenance is still there
    assert "watermark   not found" in capsys.readouterr().out


def test_mark_is_found_where_metadata_is_gone(folder, capsys):
    assert main(["render", "a.safetensors", "-o", "f.png", "--size", "256"]) == 0
    with Image.open("f.png") as picture:
        Image.fromarray(np.array(picture)).save("f.jpg", quality=80)
    found = verify("f.jpg")
    assert found.watermark.found and found.provenance == {}
    Image.new("RGB", (256, 256), (90, 120, 200)).save("plain.png")
    capsys.readouterr()
    assert main(["verify", "plain.png"]) == 1
    assert "nothing found" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["e.glb", "e.ply", "e.html", "e.npz"])
def test_exports_carry_provenance(folder, name):
    assert main(["export", "a.safetensors", "-o", name]) == 0
    assert verify(name).provenance["consent"] == "stated by the user"


def test_files_that_cannot_be_verified_are_named(folder, capsys):
    (folder / "bad.png").write_bytes(b"no picture")
    (folder / "bad.mp4").write_bytes(b"no video")
    (folder / "bad.safetensors").write_bytes(b"{}")
    (folder / "bad.ply").write_bytes(b"{}")
    (folder / "bad.glb").write_bytes(b"glTF")
    (folder / "bad.npz").write_bytes(b"PK")
    (folder / "a.splat").write_bytes(bytes(32))
    for name in ("none.png", "bad.png", "bad.mp4", "bad.safetensors", "bad.ply", "bad.glb", "bad.npz", "a.splat", ".."):
        with pytest.raises(UikaError, match="directory" if name == ".." else name):
            verify(folder / name)
        assert main(["verify", name]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    text = json.dumps(["no mapping"])
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    info.add_text("provenance", text)
    Image.new("RGB", (64, 64)).save("odd.png", pnginfo=info)
    assert not verify("odd.png").found
