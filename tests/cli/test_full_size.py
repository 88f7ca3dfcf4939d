"""The released sizes through `uika reconstruct`, with random weights and a made-up FLAME: 5 GB of disk, minutes."""

import json
import os
import subprocess
import sys
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


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4])
def test_full_size_by_command(count: int, tmp_path: Path) -> None:
    flame = bare_flame()
    save_head(flame, tmp_path / "flame.npz")
    write_full(tmp_path / "uika.safetensors", tables(flame, 384))
    photos = []
    for number in range(count):  # four files of one photo: the network does not mind
        (tmp_path / f"{number}.jpg").write_bytes(PORTRAIT.read_bytes() + b"\0" * number)
        photos.append(str(tmp_path / f"{number}.jpg"))
    words = ["--model", str(tmp_path / "uika.safetensors"), "--head", str(tmp_path / "flame.npz")]
    words += ["-o", str(tmp_path / "me.safetensors")]
    done = subprocess.run(
        [sys.executable, "-c", _RUN, "reconstruct", *photos, *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    print(count, figures)
    assert figures["code"] == 0, done.stderr[-2000:]
    assert figures["peak_gib"] < 9
    texels = len(uv_texels(flame, 384, "released"))
    assert len(Avatar.load(tmp_path / "me.safetensors")) == texels > 100_000
