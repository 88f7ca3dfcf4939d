"""The released sizes through `uika reconstruct`, with random weights and a made-up FLAME: 5 GB of disk, minutes."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.exports import bare_flame
from tests.model.released_files import write_full
from tests.released_heads import tables
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.head import save_head, uv_texels

ROOT = Path(__file__).parents[2]
_RUN = """
import json, resource, sys, time
from uika.cli import main
start = time.perf_counter()
code = main(sys.argv[1:])
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps({"code": code, "wall_s": time.perf_counter() - start, "cpu_s": time.process_time(), "peak_gib": peak}))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The weights, the head that they were made for, and four files of one photo: the network does not mind."""
    place = tmp_path_factory.mktemp("full")
    flame = bare_flame()
    save_head(flame, place / "flame.npz")
    write_full(place / "uika.safetensors", tables(flame, 384))
    for number in range(4):
        (place / f"{number}.jpg").write_bytes(PORTRAIT.read_bytes() + b"\0" * number)
    yield place
    (place / "uika.safetensors").unlink()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "precision", "most"), [(1, "bfloat16", 5), (4, "bfloat16", 6), (1, "float32", 9), (4, "float32", 10)]
)
def test_full_size_by_command(count: int, precision: str, most: float, folder: Path, tmp_path: Path) -> None:
    words = [str(folder / f"{number}.jpg") for number in range(count)]
    words += ["--model", str(folder / "uika.safetensors"), "--head", str(folder / "flame.npz")]
    words += ["--precision", precision, "-o", str(tmp_path / "me.safetensors")]
    done = subprocess.run(
        [sys.executable, "-c", _RUN, "reconstruct", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    print(count, precision, figures, done.stdout, sep="\n")
    assert figures["code"] == 0, done.stderr[-2000:]
    assert figures["peak_gib"] < most
    texels = len(uv_texels(bare_flame(), 384, "released"))
    assert len(Avatar.load(tmp_path / "me.safetensors")) == texels > 100_000
