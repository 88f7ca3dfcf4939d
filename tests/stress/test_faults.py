"""Faults of the machine: what the commands do without LLVM, a home, a second core, or when they are interrupted."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
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
