from pathlib import Path

import pytest

from drjit_splat import load_ply, load_spz
from uika.cli import main
from uika.export import glb_provenance, html_provenance, read_splat


def test_every_format_is_written(folder, capsys):
    def export(*arguments: str) -> str:
        assert main(["export", "../a.safetensors", *arguments]) == 0
        return capsys.readouterr().out

    assert "Y down" in export("-o", "a.ply") and "Y up" in export("-o", "b.ply", "--axes", "y-up")
    assert load_ply("a.ply").means[:, 1].tolist() == (-load_ply("b.ply").means[:, 1]).tolist()
    export("-o", "a.splat", "--motion", "talk", "--frame", "5", "--count", "100")
    assert len(read_splat("a.splat")) == 100
    assert "Y up" in export("-o", "a.spz")
    assert (load_spz("a.spz").means[:, 1] - load_ply("a.ply").means[:, 1]).abs().max() < 2e-5
    export("-o", "a.glb")
    assert glb_provenance("a.glb")["photos"] == "none"
    assert "85 frames" in export("-o", "a.html")
    assert html_provenance("a.html")["photos"] == "none"
    assert "100 frames" in export("-o", "a.npz", "--motion", "orbit")
    assert "bound" in export("-o", "c.ply", "--with-binding")
    assert "85 files" in export("-o", "frames", "--motion", "talk")
    assert len(list(Path("frames").iterdir())) == 85
    assert "3 morph targets, 5 joints, 85 frames at 25" in export("-o", "m.glb", "--mesh", "--motion", "talk")
    assert glb_provenance("m.glb")["photos"] == "none"
    assert "with a.mtl, a_0.png" in export("-o", "a.obj", "--motion", "talk", "--frame", "5", "--texture", "32")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["-o", "a.fbx"], "a.fbx: the output's name must end in .ply"),
        (["-o", "frames"], "needs --motion"),
        (["-o", "a.ply", "--motion", "talk"], "add --frame"),
        (["-o", "a.ply", "--frame", "3"], "--frame needs --motion"),
        (["-o", "a.ply", "--motion", "talk", "--frame", "85"], "between 0 and 84"),
        (["-o", "a.glb", "--with-binding"], "--with-binding"),
        (["-o", "a.glb", "--axes", "y-up"], "--axes"),
        (["-o", "a.ply", "--count", "0"], "count"),
        (["-o", "a.html", "--motion", "dance"], "dance"),
        (["-o", "a.ply", "--mesh"], "--mesh needs a .glb"),
        (["-o", "a.glb", "--mesh", "--motion", "talk", "--frame", "3"], "neither --frame"),
        (["-o", "a.obj", "--motion", "talk"], "add --frame"),
        (["-o", "a.glb", "--mesh", "--texture", "9999"], "--texture must lie between 16 and 8192"),
    ],
)
def test_wrong_input_is_one_sentence(folder, capsys, arguments, says):
    assert main(["export", "../a.safetensors", *arguments]) == 2
    err = capsys.readouterr().err
    assert says in err and err.count("\n") == 1
    assert list(folder.iterdir()) == []


def test_help_has_an_example(capsys):
    assert main(["export", "--help"]) == 0
    out = capsys.readouterr().out
    assert "Example: uika export" in out and out.count("\n") < 40
