"""Every command that is shown exists with its options; those that end within a minute run, the others are started."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

import drjit_splat.cli
from tests.certificates import certified
from tests.documented import PAGES, ROOT, examples, mentioned, scripted, shown
from tests.drjit_splat.training.made_up import write_colmap
from tests.exports import write_export
from tests.filmed import act
from tests.flame_files import flame_arrays, write_obj, write_pickle
from tests.released_heads import write_released
from tests.spoken import SENTENCE, spoken, write_wav
from uika import Avatar, HeadParameters, load_head, neutral_camera, reconstruct, render, write_video
from uika.assets import PORTRAIT
from uika.cli.program import _parse, main
from uika.export import posed_splats, write_ply
from uika.safeguards import mark, picture_provenance

SHOWN = list(dict.fromkeys(command for page in PAGES for command in shown(page)))
SCRIPTED = [command for page in PAGES for command in scripted(page)]
TOLD = [command for page in PAGES for command in mentioned(page)]
ALL = list(dict.fromkeys([*SHOWN, *SCRIPTED, *TOLD, *examples()]))
# What takes minutes or does not end by itself is stopped after so many seconds.
LONG = {"uika view": 20, "uika train": 60, "uika synthesize": 60, "uika evaluate": 60, "drjit-splat train": 20}
RUN = [command for command in SHOWN if command.startswith(("uika ", "drjit-splat "))]


@pytest.mark.parametrize("command", ALL)
def test_command_exists(command: str) -> None:
    program, *rest = shlex.split(command)
    if program == "uika":
        assert _understood(rest)
    elif program == "drjit-splat":
        if rest == ["--version"]:
            assert drjit_splat.cli.main(rest) == 0
        elif all(word.isalpha() for word in rest):
            assert drjit_splat.cli.main([*rest, "--help"]) == 0
        else:
            drjit_splat.cli._parser().parse_args(rest)
    elif program == "make":
        makefile = (ROOT / "Makefile").read_text()
        assert all(re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE) for target in rest)
    elif program == "pip":
        extras: list[str] = re.findall(r"\[([\w,]+)\]", command)
        folder = ROOT / "drjit_splat" if "drjit-splat[" in command else ROOT
        project = (folder / "pyproject.toml").read_text()
        assert all(f"\n{name} = [" in project for found in extras for name in found.split(","))
    elif "-m" in rest:  # python, torchrun
        module = rest[rest.index("-m") + 1]
        assert importlib.util.find_spec(module), f"there is no module {module}"
        if module == "uika":
            assert _understood(rest[rest.index("-m") + 2 :])
    else:
        script = next(word for word in rest if word.endswith(".py"))
        assert (ROOT / script).is_file(), f"there is no {script}"


def _understood(arguments: list[str]) -> bool:
    """Whether the command line can be parsed; names alone only have to be those of a command."""
    if "--head" in arguments:  # every command takes it, before it is parsed
        at = arguments.index("--head")
        arguments = arguments[:at] + arguments[at + 2 :]
    if all(word.isalpha() for word in arguments):
        arguments = [*arguments, "--help"]
    try:
        _parse(arguments)
    except SystemExit as end:
        return end.code in (0, None)
    return True


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that the commands take."""
    place = tmp_path_factory.mktemp("shown")
    for name in ("front.jpg", "side.jpg", "me.jpg"):
        shutil.copy(PORTRAIT, place / name)
    head = load_head()
    avatar: Avatar = reconstruct([PORTRAIT], head, model="none").avatar
    avatar.save(place / "me.safetensors")
    rest, camera = HeadParameters.zeros(head), neutral_camera(avatar, size=256)
    picture = mark(render(avatar, rest, camera, head).rgb)
    write_video(place / "me.mp4", [picture] * 5, 25.0, picture_provenance(avatar, watermark=True))
    act(head, place / "act.mp4")
    (place / "act.mp4").rename(place / "me.mov")
    write_ply(place / "scene.ply", posed_splats(avatar, head).half_turned())
    write_wav(place / "voice.wav", spoken(SENTENCE).samples)
    (place / "words.txt").write_text("Hello, nice to meet you.")
    for system in ("ours", "other"):
        (place / "clips" / system).mkdir(parents=True)
        shutil.copy(PORTRAIT, place / "clips" / system / "anna.jpg")
    shutil.copy(PORTRAIT, place / "drawn.png")
    view = {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": 256, "height": 256}
    (place / "cameras.json").write_text(json.dumps([view] * 4))
    write_colmap(place / "garden", binary=True)
    certified(place, ec.generate_private_key(ec.SECP256R1()))
    return place


@pytest.fixture(scope="module")
def flame_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What users of released weights have: FLAME's files (made up), weights (small, random), a photo, captures."""
    place = tmp_path_factory.mktemp("released")
    write_pickle(place / "flame2023.pkl", flame_arrays())
    write_obj(place / "flame_w_mouth.obj", flame_arrays())
    shutil.copy(PORTRAIT, place / "photo.jpg")
    write_released(place)
    write_export(place / "captures" / "306_EMO-1_v16", cameras=3)
    shutil.copytree(place / "captures" / "306_EMO-1_v16" / "flame_param", place / "flame_param")
    return place


@pytest.mark.slow
def test_script_for_released_weights_runs(flame_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(flame_folder)
    commands = scripted(ROOT / "docs" / "network.md")
    assert len(commands) == 5
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0, command


def test_scripts_without_their_files_say_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in SCRIPTED:
        words = shlex.split(command)
        words = words[words.index("uika") + 1 :] if "uika" in words else []
        words = [word.replace("/data/", "") for word in words]
        if words[:1] in (["train"], ["evaluate"], ["reconstruct"], ["animate"]):
            assert main(words) == 2, command
            assert "Traceback" not in (said := capsys.readouterr().err) and len(said.strip().splitlines()) <= 3, said


def _long(command: str) -> bool:
    return command.startswith(tuple(LONG))


@pytest.mark.parametrize("command", [command for command in RUN if not _long(command)])
def test_command_runs(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    program, *rest = shlex.split(command)
    assert (main if program == "uika" else drjit_splat.cli.main)(rest) == 0
    for at, word in enumerate(rest):
        if word == "-o":
            assert Path(rest[at + 1]).exists()


@pytest.mark.slow
@pytest.mark.parametrize("command", [command for command in RUN if _long(command)])
def test_long_command_starts(command: str, folder: Path, tmp_path: Path) -> None:
    words = shlex.split(command)
    absent = [word for word in words if word.endswith(".safetensors") and not (folder / word).exists()]
    if absent or "--video 0" in command:
        pytest.skip(f"needs {absent[0] if absent else 'a camera'}")
    data = dict(pairwise(words)).get("--data", "synthetic")
    if data != "synthetic" and not (folder / data).exists():
        few = ["--identities", "2", "--views", "3", "--frames", "4", "--size", "128"]
        assert main(["synthesize", "-o", str(folder / data), *few]) == 0
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    module = {"drjit-splat": "drjit_splat.cli"}.get(words[0], words[0])
    arguments = [sys.executable, "-m", module, *words[1:]]
    if command.startswith("uika synthesize"):
        arguments[arguments.index("-o") + 1] = str(tmp_path)  # what others read is whole
    # In a group of its own, which is interrupted as a terminal does it.
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    with subprocess.Popen(arguments, cwd=folder, env=environment, **output) as process:
        deadline = time.monotonic() + next(seconds for start, seconds in LONG.items() if command.startswith(start))
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.2)
        if process.returncode is None:
            os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=120)
    assert process.returncode in (0, 130) and "Traceback" not in said, said
