"""Pictures of splat files from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drjit_splat import load_ply, rasterization, save_ply
from drjit_splat.cli import fitting_view, load_camera, main

from .common import random_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    given = random_scene(count=200)
    harmonics = 0.3 * torch.randn(200, 9, 3, generator=torch.Generator().manual_seed(3))
    save_ply(tmp_path / "scene.ply", *(given[k] for k in ("means", "quats", "scales", "opacities")), harmonics)
    return tmp_path / "scene.ply"


def test_picture_is_the_rasterizers(scene: Path, tmp_path: Path) -> None:
    given = random_scene()
    view, K = given["viewmats"][0], given["Ks"][0]
    K[0, 2], K[1, 2] = 40, 30
    camera = {"viewmat": view.tolist(), "K": K.tolist(), "width": 80, "height": 60}
    rotation, position = view[:3, :3].mT, -view[:3, :3].mT @ view[:3, 3]
    inria = {"rotation": rotation.tolist(), "position": position.tolist(), "fx": float(K[0, 0]), "fy": float(K[1, 1])}
    (tmp_path / "c.json").write_text(json.dumps([camera, {**inria, "width": 80, "height": 60}]))
    splats = load_ply(scene)
    truth, _, _ = rasterization(
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        splats.harmonics,
        view[None],
        K[None],
        80,
        60,
        sh_degree=2,
        backgrounds=torch.zeros(1, 3),
    )
    for index in ("0", "1"):
        output = tmp_path / "new" / f"{index}.png"
        arguments = ["render", str(scene), "--camera", str(tmp_path / "c.json"), "--index", index]
        assert main([*arguments, "--background", "0", "0", "0", "-o", str(output)]) == 0
        with Image.open(output) as picture:
            pixels = torch.from_numpy(np.array(picture)) / 255
        assert (pixels - truth[0].clamp(0, 1)).abs().max() < 0.51 / 255 + 1e-4
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["0.png", "1.png"]


@pytest.mark.parametrize("y_up", [False, True])
def test_fitting_view_is_upright_and_sees_everything(scene: Path, y_up: bool) -> None:
    splats = load_ply(scene)
    view = fitting_view(splats, 20.0, 10.0, 100, y_up)
    rotation = view.viewmat[:3, :3].double()
    assert torch.linalg.det(rotation).item() == pytest.approx(1, abs=1e-5)
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double(), atol=1e-5)
    above = torch.tensor([0.0, 1.0 if y_up else -1.0, 0.0]).double()
    assert (rotation @ above)[1] < -0.9  # up in the scene is up in the picture
    local = splats.means @ view.viewmat[:3, :3].mT + view.viewmat[:3, 3]
    pixels = (local @ view.K.mT)[:, :2] / local[:, 2:]
    assert ((pixels > 0) & (pixels < 100)).all(-1).float().mean() > 0.95
    from_above = (view.viewmat[:3, :3].mT @ view.viewmat[:3, 3]).neg()[1]
    assert from_above * above[1] > 0


def test_wrong_input_is_one_sentence(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "short.json").write_text('[{"width": 8, "height": 8}]')
    cases = {
        "none.ply": [str(tmp_path / "none.ply")],
        "out.jpg": [str(scene), "-o", "out.jpg"],
        "bad.json is not JSON": [str(scene), "--camera", str(tmp_path / "bad.json")],
        "no camera 4": [str(scene), "--camera", str(tmp_path / "short.json"), "--index", "4"],
        "camera 0 cannot be used": [str(scene), "--camera", str(tmp_path / "short.json")],
        "pitch": [str(scene), "--pitch", "90"],
    }
    for says, arguments in cases.items():
        output = ["-o", str(tmp_path / "x.png")] if "-o" not in arguments else []
        assert main(["render", *arguments, *output]) == 2
        err = capsys.readouterr().err
        assert says in err and err.count("\n") == 1
    assert not (tmp_path / "x.png").exists()
    with pytest.raises(ValueError, match="there is no camera -1"):
        load_camera(tmp_path / "short.json", -1)


@pytest.mark.parametrize("arguments", [["--help"], ["render", "--help"]])
def test_help_fits_a_screen_and_has_an_example(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "Example: drjit-splat render" in out
    assert out.count("\n") <= 40 and max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("comments", [(), ("made: here",), ("one", "two")])
def test_a_scene_without_splats_is_said_to_have_none(comments: tuple[str, ...], tmp_path: Path, capsys) -> None:
    empty = {name: torch.zeros(0, size) for name, size in (("means", 3), ("quats", 4), ("scales", 3), ("colors", 3))}
    save_ply(tmp_path / "zero.ply", **empty, opacities=torch.zeros(0), comments=comments)
    assert main(["render", str(tmp_path / "zero.ply"), "-o", str(tmp_path / "o.png")]) == 2
    assert "zero.ply holds no splats" in capsys.readouterr().err
    assert not (tmp_path / "o.png").exists()
