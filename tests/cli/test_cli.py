import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args

import av
import numpy as np
import pytest
import torch
from PIL import Image

from uika import Avatar
from uika.cli import main
from uika.cli.commands import Command


def _fails(capsys, *arguments: str, code: int = 2) -> str:
    assert main(arguments) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1 and err.startswith("uika: "), err
    assert "Traceback" not in err
    return err


def test_import_is_light():
    code = (
        "import sys, json, uika, drjit_splat; heavy = ('torch', 'mitsuba', 'mediapipe', 'viser', 'drjit', 'av', 'PIL');"
        "print(json.dumps([name for name in heavy if name in sys.modules]))"
    )
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
    assert time.perf_counter() - start < 3


def test_public_names_stay_what_they_are():
    import uika
    import uika.avatar.rendering
    import uika.reconstruction

    # Importing modules must not hide the functions of the package.
    for name in uika.__all__:
        assert getattr(uika, name) is not None
    assert callable(uika.render) and callable(uika.reconstruct)
    with pytest.raises(AttributeError, match="nothing"):
        _ = uika.nothing


def test_render_and_animate_write_what_was_asked(folder, capsys):
    assert main(["render", "../a.safetensors", "-o", "new/f.png", "--yaw", "40", "--size", "64"]) == 0
    with Image.open("new/f.png") as picture:
        assert picture.size == (64, 64) and np.asarray(picture).min() < 100
    np.savez("m.npz", fps=10, expression=np.zeros((3, 3)))
    assert main(["animate", "../a.safetensors", "--motion", "m.npz", "-o", "v.mp4", "--size", "64"]) == 0
    with av.open("v.mp4") as container:
        assert sum(1 for _ in container.decode(video=0)) == 3
    assert "3 frames" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["render", "../none.safetensors"], "none.safetensors: no such avatar file"),
        (["render", ".."], "directory"),
        (["render", "../a.safetensors", "-o", "f.jpg"], "f.jpg: the output's name must end in .png"),
        (["render", "../a.safetensors", "-o", "../small.npz/f.png"], "small.npz is not a folder"),
        (["render", "../a.safetensors", "--pitch", "95"], "pitch"),
        (["render", "../a.safetensors", "--size", "0"], "size"),
        (["render", "../small.npz", "-o", "f.png"], "small.npz: is truncated, damaged or not an avatar"),
        (["animate", "../a.safetensors", "-o", "v.avi"], "v.avi"),
        (["animate", "../a.safetensors", "--size", "65"], "even"),
        (["animate", "../a.safetensors", "--motion", "dance"], "dance"),
        (["animate", "../a.safetensors", "--motion", "none.npz"], "none.npz"),
        (["animate", "../a.safetensors", "--fps", "0"], "fps"),
        (["reconstruct"], "at least one photo"),
        (["reconstruct", "none.jpg"], "none.jpg: no such photo"),
        (["reconstruct", ".."], "directory"),
        (["reconstruct", "../small.npz", "-o", "a.ply"], "a.ply"),
        (["reconstruct", "../small.npz", "--model", "huge"], "huge"),
        (["reconstruct", "../small.npz"], "small.npz"),
        (["demo", "-o", "../small.npz"], "small.npz"),
    ],
)
def test_wrong_input_is_one_sentence(folder, capsys, arguments, says):
    assert says in _fails(capsys, *arguments)
    assert list(folder.iterdir()) == []


def test_truncated_avatar_and_other_head_are_named(folder, capsys):
    whole = Path("../a.safetensors").read_bytes()
    Path("../cut.safetensors").write_bytes(whole[: len(whole) // 2])
    assert "cut.safetensors" in _fails(capsys, "render", "../cut.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("UIKA_HEAD")
        assert "'synthetic-1'" in _fails(capsys, "animate", "../a.safetensors")
        patch.setenv("UIKA_HEAD", "nowhere.npz")
        assert "nowhere.npz" in _fails(capsys, "render", "../a.safetensors")
    assert list(folder.iterdir()) == []


def test_photo_without_a_face_is_named(folder, capsys):
    Image.new("RGB", (200, 200), (120, 130, 140)).save("../flat.png")
    assert "flat.png" in _fails(capsys, "reconstruct", "../flat.png")
    Image.new("RGB", (8, 8)).save("../tiny.png")
    assert "tiny.png" in _fails(capsys, "reconstruct", "../tiny.png")
    assert list(folder.iterdir()) == []


def test_debug_shows_the_traceback(folder, capsys):
    assert main(["--debug", "render", "none.safetensors"]) == 2
    assert "Traceback" in capsys.readouterr().err


COMMANDS = [command.__name__.lower() for command in get_args(Command)]


@pytest.mark.parametrize("command", ["", *COMMANDS, "head import", "head show"])
def test_help_fits_a_screen_and_has_an_example(capsys, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*command.split(), "--help"]) == 0
    out = capsys.readouterr().out
    assert f"Example: uika {command}" in " ".join(out.split())
    assert sum(max(1, math.ceil(len(line) / 80)) for line in out.splitlines()) <= 40
    if not command:
        assert all(f"\n  {name} " in out for name in COMMANDS)


def test_usage_errors_exit_with_2(capsys):
    assert main([]) == 2
    assert main(["sing"]) == 2
    assert main(["render", "a.safetensors", "--size", "big"]) == 2


def test_doctor_names_versions_and_llvm(capsys):
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert torch.__version__.split("+")[0] in out and "LLVM" in out and "threads" in out and "builtin-2" in out


def test_doctor_fails_without_a_head_or_llvm(tmp_path):
    environment = {**os.environ, "UIKA_HEAD": "nowhere.npz", "DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    command = [sys.executable, "-m", "uika", "doctor"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 1 and done.stderr == ""
    assert "nowhere.npz" in done.stdout and "DRJIT_LIBLLVM_PATH" in done.stdout


def test_rendering_without_llvm_is_one_sentence(folder, tmp_path):
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    command = [sys.executable, "-m", "uika", "render", "../a.safetensors"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "libllvm" in done.stderr.lower()
    assert list(folder.iterdir()) == []


@pytest.mark.slow
def test_interrupt_leaves_no_file(folder):
    command = [sys.executable, "-m", "uika", "animate", "../a.safetensors", "--motion", "orbit", "--fps", "240"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(folder.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err and err.endswith("interrupted\n")
    assert list(folder.iterdir()) == []


def test_failed_reconstruction_keeps_the_old_file(folder, capsys):
    Path("a.safetensors").write_bytes(b"old")
    assert "flat" in _fails(capsys, "reconstruct", _flat(folder), "-o", "a.safetensors")
    assert Path("a.safetensors").read_bytes() == b"old"


def _flat(folder: Path) -> str:
    path = folder.parent / "flat.png"
    Image.new("L", (64, 64), 200).save(path)
    return str(path)


def test_avatar_written_by_one_process_is_read_by_another(folder):
    code = "from uika import Avatar; print(len(Avatar.load('../a.safetensors')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == len(Avatar.load("../a.safetensors"))
