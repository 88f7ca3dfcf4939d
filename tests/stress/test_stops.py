"""Commands that are interrupted, killed, or meet a full disk: what lies under a final name afterwards is whole."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open

from tests.avatars import painted_avatar
from uika.assets import PORTRAIT
from uika.head import load_head
from uika.tracking.decode import decode

from .conftest import LONG, Worst

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="skipped: needs Linux")]
STOPS = int(os.environ.get("UIKA_STOPS", 6 if LONG else 1))
# Words of each command, and the seconds within which it is stopped.
COMMANDS = {
    "animate": (("animate", "{avatar}", "--motion", "orbit", "-o", "out/a.mp4", "--size", "128"), 6),
    "reconstruct": (("reconstruct", "{photo}", "-o", "out/a.safetensors"), 8),
    "synthesize": (("synthesize", "-o", "out", "--identities", "2", "--size", "32"), 12),
    "train": (
        *(("train", "--data", "{people}", "-o", "out", "--preset", "tiny", "--images", "2", "--size", "64"),),
        30,
    ),
}
TRAIN = ("--steps", "4", "--save-every", "1", "--workers", "1")


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "uika", *words]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("made")
    avatar = folder / "a.safetensors"
    painted_avatar(load_head()).save(avatar)
    words = ("synthesize", "-o", "people", "--identities", "2", "--size", "64", "--no-archives")
    subprocess.run(command(*words), cwd=folder, check=True, capture_output=True)
    return {"avatar": avatar, "photo": PORTRAIT, "people": folder / "people"}


def words_of(name: str, places: dict[str, Path]) -> list[str]:
    words, _ = COMMANDS[name]
    return [word.format(**places) for word in (*words, *(TRAIN if name == "train" else ()))]


def check_whole(folder: Path) -> int:
    """Read every file that has its final name; the number of them."""
    count = 0
    for path in folder.rglob("*"):
        parts = path.relative_to(folder).parts
        if not path.is_file() or any(part.startswith((".", "tensorboard")) or ".part" in part for part in parts):
            continue
        count += 1
        if path.suffix == ".mp4":
            assert len(list(decode(path))) > 1, path
        elif path.suffix == ".safetensors":
            with safe_open(path, framework="pt") as file:
                assert file.keys(), path
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".jsonl":  # grows line by line; the reader drops a last one that is torn
            for line in path.read_text().splitlines()[:-1]:
                json.loads(line)
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                assert [file[name] for name in file.files], path
        elif path.suffix == ".png":
            with Image.open(path) as image:
                image.load()
    return count


@pytest.mark.parametrize("name", list(COMMANDS))
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL], ids=["SIGINT", "SIGKILL"])
def test_stopped_at_a_random_moment(
    name: str, kind: signal.Signals, places: dict[str, Path], tmp_path: Path, worst: Worst
) -> None:
    rng = random.Random(f"{name}{kind}")
    for _ in range(STOPS):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        process = subprocess.Popen(
            command(*words_of(name, places)),
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # A background shell ignores interrupts, and so would its children.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        time.sleep(rng.uniform(0.5, COMMANDS[name][1]))
        if process.poll() is None:
            process.send_signal(kind)
            started = time.monotonic()
            _, error = process.communicate(timeout=60)
            ended = worst(f"{name}, {kind.name}: seconds to end", time.monotonic() - started)
            if kind == signal.SIGINT:
                assert ended < 2.0 * max(1, os.getloadavg()[0] / (os.cpu_count() or 1))
                assert "Traceback" not in error and error.endswith("interrupted\n"), error
                assert process.returncode == 130
                if ended < 1.4:  # or the process did not wait for an operator that took longer, nor clean up behind it
                    assert not [path for path in (tmp_path / "out").rglob(".*") if path.is_file()]
        else:
            process.communicate()
        check_whole(tmp_path / "out")
    if name in ("synthesize", "train"):
        more = ("--resume",) if name == "train" and (tmp_path / "out" / "log.jsonl").is_file() else ()
        done = subprocess.run(command(*words_of(name, places), *more), cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert check_whole(tmp_path / "out") > 2


def full_disk(kilobytes: int) -> list[str]:
    """Words that run a command with `out` on a disk of that size; empty where that is not allowed."""
    script = f'mkdir -p out && mount -t tmpfs -o size={kilobytes}k tmpfs out && "$@"; code=$?; ls -A out; exit $code'
    words = ["unshare", "--mount", "--map-root-user", "sh", "-c", script, "sh"]
    with tempfile.TemporaryDirectory() as empty:
        if (
            shutil.which("unshare") is None
            or subprocess.run([*words, "true"], cwd=empty, capture_output=True).returncode
        ):
            return []
    return words


@pytest.mark.parametrize(
    ("name", "kilobytes"), [("animate", 8), ("reconstruct", 1024), ("synthesize", 1024), ("train", 24 * 1024)]
)
def test_full_disk(name: str, kilobytes: int, places: dict[str, Path], tmp_path: Path) -> None:
    before = full_disk(kilobytes)
    if not before:
        pytest.skip("mounting is not allowed here")
    words = words_of(name, places)
    done = subprocess.run([*before, *command(*words)], cwd=tmp_path, capture_output=True, text=True, timeout=1200)
    sentence = done.stderr.splitlines()[-1]
    assert done.returncode == 2 and ("No space left" in sentence or "the disk is full" in sentence), done.stderr
    assert "Traceback" not in done.stderr
    assert [line for line in done.stdout.splitlines() if line.endswith((".mp4", ".safetensors", ".part"))] == []
