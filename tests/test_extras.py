"""Each extra alone, from a wheel in a fresh environment, does what it is for; pip needs its index for that."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.avatars import painted_avatar
from uika import load_head
from uika.assets import PORTRAIT

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parent.parent
COMMANDS = (
    "reconstruct animate render track export view verify synthesize train evaluate head weights bench demo doctor"
)
FEW = ("--identities", "2", "--views", "3", "--frames", "2", "--size", "128")


class Installed:
    """The project's wheel with one extra in an environment of its own; `run` works in an empty folder."""

    def __init__(self, wheels: Path, extra: str, place: Path) -> None:
        self.folder, self._bin = place / "work", place / "venv" / ("Scripts" if os.name == "nt" else "bin")
        self.folder.mkdir()
        # Neither the checkout nor a variable of this process may lend a package.
        self.environment = {
            key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL"))
        }
        subprocess.run([sys.executable, "-m", "venv", str(place / "venv")], check=True)
        pip = ("python", "-m", "pip", "install", "-q", "--disable-pip-version-check", "--find-links", wheels)
        wanted = extra if extra.startswith("drjit-splat") else f"uika-drjit[{extra}]" if extra else "uika-drjit"
        self.run(*pip, "-c", ROOT / "constraints.txt", wanted)

    def command(self, *words: str | Path) -> list[str]:
        program, *rest = map(str, words)
        return [str(self._bin / program), *rest]

    def run(self, *words: str | Path, code: int = 0) -> str:
        done = subprocess.run(
            self.command(*words), cwd=self.folder, env=self.environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == code and "Traceback" not in done.stderr, done.stdout + done.stderr
        return done.stdout + done.stderr


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("wheels")
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*pip, "-w", str(place), str(ROOT / "drjit_splat"), str(ROOT)], check=True)
    return place


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "me.safetensors"
    painted_avatar(load_head()).save(path)
    return path


@pytest.fixture
def installed(request: pytest.FixtureRequest, wheels: Path, tmp_path: Path) -> Iterator[Installed]:
    yield Installed(wheels, request.param, tmp_path)
    shutil.rmtree(tmp_path)  # gigabytes


def only(extra: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("installed", [extra], indirect=True, ids=[extra or "core"])


@only("drjit-splat[train]")
def test_the_splatting_alone_passes_its_tests(installed: Installed) -> None:
    assert "drjit-splat " in installed.run("drjit-splat", "--version")
    listed = installed.run("python", "-m", "pip", "list", "--format", "freeze", "--disable-pip-version-check").lower()
    names = {line.partition("==")[0] for line in listed.splitlines()}
    assert names >= {"drjit-splat", "torch", "pillow"} and not names & {"uika-drjit", "mitsuba", "viser", "scipy"}
    tests = ("pytest", "hypothesis", "scipy", "zstandard")  # what the tests themselves need
    installed.run("python", "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", *tests)
    # The examples' portrait is uika's, and the page needs a browser.
    own = shutil.ignore_patterns("test_examples.py", "test_page.py", "__pycache__")
    shutil.copytree(ROOT / "tests" / "drjit_splat", installed.folder / "tests" / "drjit_splat", ignore=own)
    for name in ("tests/__init__.py", "tests/recorded.py", "tests/conftest.py", "pyproject.toml"):
        shutil.copy(ROOT / name, installed.folder / name)
    said = installed.run("python", "-m", "pytest", "-q", "tests/drjit_splat")
    assert " failed" not in said and " passed" in said, said


@only("")
def test_the_core_splats_and_names_what_a_command_lacks(installed: Installed) -> None:
    script = (
        "import sys, torch; from drjit_splat import rasterization\n"
        "means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)\n"
        "K = torch.tensor([[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]])\n"
        "image, alpha, meta = rasterization(means, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1),\n"
        "    torch.ones(1), torch.ones(1, 3), torch.eye(4)[None], K, 32, 32)\n"
        "image.square().sum().backward(); assert float(image.max()) > 0.5 and means.grad.isfinite().all()\n"
        "import uika; head = uika.load_head()\n"
        "assert not {'scipy', 'PIL', 'mitsuba', 'ai_edge_litert', 'viser', 'tyro'} & set(sys.modules)"
    )
    installed.run("python", "-c", script)
    said = installed.run("uika", "render", "me.safetensors", code=2)
    assert 'pip install "uika-drjit[cli]"' in said and said.count("\n") == 1, said


@only("cli")
def test_cli_shows_help_renders_and_exports(installed: Installed, avatar: Path) -> None:
    for command in COMMANDS.split():
        assert "--help" in installed.run("uika", command, "--help"), command
    installed.run("drjit-splat", "--help")
    installed.run("uika", "render", avatar, "-o", "me.png", "--size", "64")
    installed.run("uika", "animate", avatar, "--motion", "expressions", "-o", "me.mp4", "--size", "64")
    installed.run("uika", "export", avatar, "-o", "me.ply")
    said = installed.run("uika", "reconstruct", PORTRAIT, "-o", "you.safetensors", code=2)
    assert 'pip install "uika-drjit[photo]"' in said and said.count("\n") == 1, said
    assert {path.name for path in installed.folder.iterdir()} >= {"me.png", "me.mp4", "me.ply"}


@only("photo")
def test_photo_reconstructs(installed: Installed) -> None:
    installed.run("uika", "demo", "-o", "demo")
    assert {path.name for path in (installed.folder / "demo").iterdir()} == {
        "avatar.safetensors",
        "talk.mp4",
        "sheet.png",
    }
    installed.run("uika", "track", "demo/talk.mp4", "-o", "motion.npz")


@only("scenes")
def test_scenes_renders_and_validates(installed: Installed) -> None:
    installed.run("python", "-m", "scenes.validate", "-o", "report", "--quick")
    assert (installed.folder / "report" / "index.html").is_file()


@only("view")
def test_view_serves_the_page(installed: Installed, avatar: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = installed.command("uika", "view", avatar, "--port", str(port))
    with subprocess.Popen(words, cwd=installed.folder, env=installed.environment, stderr=subprocess.PIPE) as server:
        deadline, page = time.monotonic() + 300, b""
        while not page and server.poll() is None and time.monotonic() < deadline:
            try:
                page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10).read()
            except OSError:
                time.sleep(0.5)
        server.send_signal(signal.SIGINT)
        _, said = server.communicate(timeout=60)
    assert b"<html" in page.lower(), said.decode()
    # What the viewer saves as a still is filled and smoothed with scipy.
    installed.run("python", "-c", "import scipy.sparse, uika.viewer.page, uika.viewer.panels")


@only("train")
def test_train_makes_data_trains_and_evaluates(installed: Installed) -> None:
    installed.run("uika", "synthesize", "-o", "people", *FEW)
    installed.run(
        "uika", "train", "--data", "people", "-o", "run", "--preset", "tiny", "--steps", "2", "--workers", "0"
    )
    network = next(installed.folder.glob("run/*.safetensors"))
    given = ("--model", network, "--setting", "mono", "--views", "1", "--targets", "1", "--size", "96")
    installed.run("uika", "evaluate", "--data", "people", "-o", "report", "--correspondence", "exact", *given)


@only("bake")
def test_bake_makes_the_head(installed: Installed) -> None:
    installed.run("python", ROOT / "tools" / "bake_head.py", "-o", "head.npz")
    installed.run("python", "-c", "import uika; uika.load_head('head.npz')")


@only("all")
def test_all_brings_no_tool_of_development(installed: Installed) -> None:
    listed = installed.run("python", "-m", "pip", "list", "--format", "freeze", "--disable-pip-version-check").lower()
    names = {line.partition("==")[0] for line in listed.splitlines()}
    assert names >= {"mitsuba", "ai-edge-litert", "viser", "webdataset", "tyro", "scipy"}
    assert not names & {"pytest", "ruff", "mypy", "mkdocs", "gsplat", "hypothesis", "onnxruntime"}
    installed.run("uika", "doctor")
