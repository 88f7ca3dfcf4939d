"""Faults of the machine: what the commands do without LLVM, a home, a second core, or when they are interrupted."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.avatars import painted_avatar
from uika.head import load_head

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="skipped: needs Linux")]
OLD = [Path(f"/usr/lib/x86_64-linux-gnu/libLLVM-{version}.so.1") for version in (14, 15)]


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "a.safetensors"
    painted_avatar(load_head()).save(path)
    return path


def run(*arguments: object, cwd: Path, before: tuple[str, ...] = (), **environment: str | None) -> tuple[int, str]:
    """Exit code and stderr of a command with changed environment variables; None removes one."""
    variables = {k: v for k, v in {**os.environ, **environment}.items() if v is not None}
    command = [*before, sys.executable, "-m", "uika", *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, env=variables, capture_output=True, text=True, check=False, timeout=300)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("before", "environment"),
    [
        ((), {"HOME": None}),
        ((), {"HOME": "/proc/none"}),
        (("taskset", "-c", "0"), {}),
        ((), {"OMP_NUM_THREADS": "1"}),
        ((), {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    ],
    ids=["no HOME", "HOME that cannot be written", "one core", "one OpenMP thread", "locale C"],
)
def test_rendering_works(avatar: Path, tmp_path: Path, before: tuple[str, ...], environment: dict[str, str]) -> None:
    if before and shutil.which(before[0]) is None:
        pytest.skip(f"{before[0]} is not installed")
    code, error = run("render", avatar, "-o", "a.png", "--size", 64, cwd=tmp_path, before=before, **environment)
    # Dr.Jit says in one line that it keeps no kernels on disk.
    assert code == 0 and (not error or (error.startswith("jit_init()") and error.count("\n") == 1)), error
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_spaces_and_emoji_in_paths(avatar: Path, tmp_path: Path) -> None:
    folder = tmp_path / "my photos 🙂 ü"
    folder.mkdir()
    shutil.copy(avatar, folder / "mé 🙂.safetensors")
    code, error = run("render", folder / "mé 🙂.safetensors", "-o", folder / "främe 🙂.png", "--size", 64, cwd=tmp_path)
    assert (code, error) == (0, "")
    assert (folder / "främe 🙂.png").is_file()


@pytest.mark.parametrize("library", [*OLD, Path("/none/libLLVM.so")], ids=lambda path: path.name)
def test_an_llvm_that_cannot_serve_is_one_sentence(avatar: Path, tmp_path: Path, library: Path) -> None:
    if library in OLD and not library.is_file():
        pytest.skip(f"{library} is not installed")
    code, error = run("render", avatar, "--size", 64, cwd=tmp_path, DRJIT_LIBLLVM_PATH=str(library))
    assert code in (1, 2) and error.count("\n") == 1 and "libllvm" in error.lower(), error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_refused_before_work(avatar: Path, tmp_path: Path) -> None:
    if os.geteuid() == 0:
        place = Path("/proc/x.png")  # root may write everywhere else
    else:
        (tmp_path / "locked").mkdir(mode=0o500)
        place = tmp_path / "locked" / "x.png"
    code, error = run("render", avatar, "-o", place, "--size", 64, cwd=tmp_path)
    assert code == 2 and error.count("\n") == 1, error


COMMANDS = {
    "animate": ("animate", "{avatar}", "--motion", "orbit", "--fps", "240", "-o", "out/a.mp4", "--size", "128"),
    "reconstruct": ("reconstruct", "{photo}", "-o", "out/a.safetensors"),
    "synthesize": ("synthesize", "-o", "out", "--identities", "50", "--size", "64"),
}
PHOTO = Path(__file__).resolve().parents[2] / "uika" / "assets" / "portrait.jpg"


@pytest.mark.parametrize("name", list(COMMANDS))
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL], ids=["SIGINT", "SIGKILL"])
def test_stopped_at_a_random_moment(name: str, kind: signal.Signals, avatar: Path, tmp_path: Path) -> None:
    words = [word.format(avatar=avatar, photo=PHOTO) for word in COMMANDS[name]]
    rng = random.Random(f"{name}{kind}")
    for _ in range(2):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        process = subprocess.Popen(
            [sys.executable, "-m", "uika", *words],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(
                signal.SIGINT, signal.default_int_handler
            ),  # a background shell ignores it
        )
        time.sleep(rng.uniform(1.0, 8.0))
        if process.poll() is not None:
            process.communicate()
            continue
        process.send_signal(kind)
        started = time.monotonic()
        _, error = process.communicate(timeout=60)
        assert time.monotonic() - started < 2.0 * max(1, os.getloadavg()[0] / (os.cpu_count() or 1))
        found = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
        if kind == signal.SIGINT:
            assert "Traceback" not in error and error.endswith("interrupted\n"), error
            assert not [path for path in found if path.name.startswith(".")]
        whole = [path for path in found if not path.name.startswith(".") and path.suffix in (".mp4", ".safetensors")]
        assert whole == []
