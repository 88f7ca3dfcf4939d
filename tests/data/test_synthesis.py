import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from uika.data import DataError, Synthesis, open_capture, shard_samples, synthesize
from uika.data.encode import DEPTH_UNIT
from uika.errors import UikaError
from uika.head import load_head, pose_vertices, project, rasterize

pytest.importorskip("mitsuba", reason="skipped: Mitsuba is not installed")
pytestmark = pytest.mark.skipif("UIKA_HEAD" in os.environ, reason="skipped: another head is chosen")
ROOT = Path(__file__).resolve().parents[2]


def hashes(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def settings(folder: Path, shard: str = "0/1", identities: int = 2) -> Synthesis:
    return Synthesis(folder, identities, views=3, frames=2, size=64, seed=5, shard=shard)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    report = synthesize(settings(folder), progress=False)
    assert (report.made, report.kept, report.images) == (2, 0, 12)
    return folder


def test_labels_fit_the_parameters_and_cameras(made: Path) -> None:
    head = load_head().without_bust
    capture = open_capture(made / "captures" / "000001", strict=True)
    assert len(capture) == 6
    for sample in capture.samples(strict=True):
        assert sample.parameters is not None and sample.uv is not None and sample.uv_valid is not None
        assert sample.depth is not None and sample.static_offset is not None
        vertices = pose_vertices(head, sample.parameters, sample.static_offset)
        xy, z = project(vertices, sample.camera)
        triangle, barycentric = rasterize(xy, head.faces, 64, 64, z, cull="none")
        covered = triangle >= 0
        # Glasses hide some of the head, nothing else does.
        assert (covered & sample.uv_valid).sum() / covered.sum() > 0.9
        assert (sample.uv_valid & ~covered).sum() / covered.sum() < 0.01
        uv = (head.uvs[head.uv_faces[triangle]] * barycentric[..., None]).sum(-2)
        uv[..., 1] = 1 - uv[..., 1]
        both = covered & sample.uv_valid
        assert (uv - sample.uv).abs()[both].median() < 1e-4
        depth = (z[head.faces[triangle]] * barycentric).sum(-1)
        assert (depth - sample.depth).abs()[both].median() < 2 * DEPTH_UNIT
        assert ((sample.mask > 0.99) & ~covered).sum() < 0.02 * covered.sum() + 30
        inside = sample.image[:, sample.mask > 0.99]
        assert inside.std() > 0.05 and 0.05 < inside.mean() < 0.95


def test_shards_hold_the_same_samples(made: Path) -> None:
    capture = open_capture(made / "captures" / "000000")
    shard = list(shard_samples(made / "shards" / "000000.tar", strict=True))
    assert len(shard) == len(capture)
    for one, other in zip(capture.samples(), shard, strict=True):
        assert (one.key, one.identity, one.timestep) == (other.key, other.identity, other.timestep)
        for name in ("image", "mask", "uv", "depth", "static_offset"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=0, rtol=0)
        torch.testing.assert_close(one.camera.viewmat, other.camera.viewmat)
        assert one.parameters is not None and other.parameters is not None
        torch.testing.assert_close(one.parameters.expression, other.parameters.expression)


def test_webdataset_reads_the_shards(made: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="skipped: webdataset is not installed")
    url = str(made / "shards" / "000000.tar")
    with (made / "shards" / "000000.tar").open("rb") as stream:
        files = list(webdataset.tariterators.tar_file_expander([{"url": url, "stream": stream}]))
        groups = [group for group in webdataset.tariterators.group_by_keys(iter(files)) if "png" in group]
    assert len(groups) == 6 and {"mask.png", "uv.png", "depth.png", "flame.npz", "json"} <= set(groups[0])


def test_parts_of_a_set_equal_the_whole(made: Path, tmp_path: Path) -> None:
    for shard in ("1/2", "0/2"):
        assert synthesize(settings(tmp_path, shard), progress=False).made == 1
    assert hashes(tmp_path) == hashes(made)


def test_people_and_views_differ(made: Path) -> None:
    images = [s.image for i in range(2) for s in open_capture(made / "captures" / f"{i:06d}").samples()]
    for first in range(len(images)):
        for second in range(first):
            assert float((images[first] - images[second]).abs().mean()) > 1e-3


def test_a_complete_set_is_left_alone_and_another_one_refused(made: Path) -> None:
    before = hashes(made)
    assert synthesize(settings(made), progress=False).kept == 2
    with pytest.raises(UikaError, match="made with other values"):
        synthesize(Synthesis(made, 2, views=3, frames=2, size=64, seed=6), progress=False)
    assert hashes(made) == before


def test_a_shard_lost_or_torn_is_noticed(made: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.tar"
    torn.write_bytes((made / "shards" / "000000.tar").read_bytes()[:30000])
    with pytest.raises(DataError, match=r"torn\.tar"):
        list(shard_samples(torn, strict=True))


def test_bad_settings_are_named(tmp_path: Path) -> None:
    for shard in ("2/2", "x", "1", "-1/2"):
        with pytest.raises(UikaError, match="shard must be i/n"):
            synthesize(settings(tmp_path, shard), progress=False)
    with pytest.raises(UikaError, match="views must lie"):
        synthesize(Synthesis(tmp_path, 1, views=0), progress=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(UikaError, match="file"):
        synthesize(settings(tmp_path / "file"), progress=False)
    assert np.array_equal([path.name for path in tmp_path.iterdir()], ["file"])


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 400 KiB."""
    place = tmp_path / "disk"
    place.mkdir()
    made = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=400k", "none", str(place)], capture_output=True
    )
    if not made or made.returncode:
        pytest.skip("skipped: a small file system needs the right to mount one")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_full_disk_is_named_and_the_set_completed_later(made: Path, small_disk: Path) -> None:
    with pytest.raises(UikaError, match=f"{small_disk}: the disk is full; free space and run the same command again"):
        synthesize(settings(small_disk), progress=False)
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    complete = [path.name for path in (small_disk / "captures").iterdir() if not path.name.startswith(".")]
    assert len(complete) < 2
    synthesize(settings(small_disk), progress=False)
    assert hashes(small_disk) == hashes(made)


def test_a_full_folder_for_temporary_files_is_named(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys; from pathlib import Path; from uika.data import Synthesis, synthesize\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (60000, 60000))\n"
        "synthesize(Synthesis(Path(sys.argv[1]), 2, views=3, frames=2, size=64, seed=5), progress=False)"
    )
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 1 and "a temporary mesh cannot be written; free space or set TMPDIR" in run.stderr
    assert not list(tmp_path.rglob("*.tar"))


@pytest.mark.slow
def test_killed_runs_are_completed_bit_for_bit(made: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from uika.data import Synthesis, synthesize\n"
        "synthesize(Synthesis(Path(sys.argv[1]), 2, views=3, frames=2, size=64, seed=5), progress=False)"
    )
    chance = random.Random(0)
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT)
        deadline = time.monotonic() + 120
        # Wait for the first file, so that the kill falls into the work and not into the imports.
        while time.monotonic() < deadline and process.poll() is None and not any(tmp_path.rglob("*.npz")):
            time.sleep(0.02)
        time.sleep(chance.uniform(0.0, 3.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
    synthesize(settings(tmp_path), progress=False)
    assert hashes(tmp_path) == hashes(made)
