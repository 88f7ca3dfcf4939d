"""Sets too large to be made at once or kept as loose files: resuming within a person, indices, small files."""

import importlib
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.data.test_synthesis import hashes
from uika.cli import main
from uika.data import DataError, Synthesis, open_capture, shard_samples, synthesize, write_shard
from uika.data.datasets import Shard, find_people
from uika.data.encode import decode_colour, encode_jpeg
from uika.data.labels import tracked_uv
from uika.data.shard_index import build_index, index_path, open_index, scan, write_index
from uika.data.shard_writer import ShardWriter
from uika.data.views import View
from uika.errors import UikaError
from uika.head import load_head

pytest.importorskip("mitsuba", reason="skipped: Mitsuba is not installed")
pytestmark = pytest.mark.skipif("UIKA_HEAD" in os.environ, reason="skipped: another head is chosen")
SMALL = {"identities": 1, "views": 2, "frames": 4, "size": 64, "seed": 5}


@pytest.fixture(scope="module")
def lean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shards alone, with JPEG and no labels."""
    folder = tmp_path_factory.mktemp("lean")
    words = [f"--{name}={value}" for name, value in SMALL.items()]
    assert main(["synthesize", "-o", str(folder), *words, "--no-captures", "--labels=tracked", "--images=jpeg"]) == 0
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    synthesize(Synthesis(folder, **SMALL), progress=False)
    return folder


def test_shards_alone_hold_what_the_others_hold(lean: Path, whole: Path, tmp_path: Path) -> None:
    assert not (lean / "captures").exists()
    synthesize(Synthesis(tmp_path, **SMALL, captures=False), progress=False)
    assert hashes(tmp_path / "shards") == hashes(whole / "shards")
    (path,) = find_people(lean)
    person, truth = Shard(path), open_capture(whole / "captures" / "000000")
    assert len(person) == len(truth) == 8
    for index in range(8):
        small, full = person.sample(index), truth.sample(index)
        assert (small.key, small.identity, small.uv) == (full.key, full.identity, None)
        assert small.parameters is not None and full.parameters is not None
        torch.testing.assert_close(small.parameters.expression, full.parameters.expression, rtol=0, atol=0)
        assert 0 < float((small.image - full.image).abs().mean()) < 0.01
    assert [sample.key for sample in shard_samples(path, strict=True)] == [person.sample(i).key for i in range(8)]


def test_labels_come_back_from_the_parameters(lean: Path, whole: Path) -> None:
    head = load_head().without_bust
    small, full = Shard(find_people(lean)[0]).sample(0), open_capture(whole / "captures" / "000000").sample(0)
    exact = View(full, 64).uv
    found = tracked_uv(View(small, 64), head)
    assert exact is not None
    both = torch.isfinite(exact).all(0) & torch.isfinite(found).all(0)
    assert float(both.sum()) > 0.9 * float(torch.isfinite(exact).all(0).sum())
    assert float((exact - found).abs()[:, both].median()) < 1e-4


def test_files_are_small(lean: Path, whole: Path) -> None:
    sizes = [sum(path.stat().st_size for path in (root / "shards").glob("*.tar")) for root in (lean, whole)]
    assert sizes[0] < 0.7 * sizes[1]


class StoppedError(Exception):
    pass


@pytest.mark.parametrize("form", [{"captures": False}, {"archives": False}])
def test_an_interrupted_person_is_gone_on_with(form: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module(Synthesis.__module__)
    synthesize(Synthesis(tmp_path / "whole", **SMALL, **form), progress=False)
    real, made = module.record_identity, []

    def watched(head, seed, identity, recording, start=0):
        shared, moments = real(head, seed, identity, recording, start)

        def counted():
            for place, moment in enumerate(moments, start):
                if place == 3 and not made:
                    made.append("stopped")
                    raise StoppedError
                made.append(place) if made else None
                yield moment

        return shared, counted()

    monkeypatch.setattr(module, "record_identity", watched)
    settings = Synthesis(tmp_path / "cut", **SMALL, **form)
    with pytest.raises(StoppedError):
        synthesize(settings, progress=False)
    if form.get("captures") is False:  # a kill may fall between any two bytes
        (partial,) = (tmp_path / "cut" / "shards").glob(".*.partial.tar")
        with partial.open("r+b") as file:
            file.truncate(partial.stat().st_size - 700)
    synthesize(settings, progress=False)
    assert made[0] == "stopped" and 1 <= made[1] <= 3  # not from the start
    assert hashes(tmp_path / "cut") == hashes(tmp_path / "whole")


def test_an_index_says_what_the_file_holds(whole: Path) -> None:
    path = find_people(whole / "shards")[0]
    kept = open_index(path)
    found = build_index(scan(path, path.stat().st_size))
    assert (kept.keys, kept.extensions) == (found.keys, found.extensions)
    np.testing.assert_array_equal(kept.offsets, found.offsets)
    np.testing.assert_array_equal(kept.sizes, found.sizes)


def test_an_index_of_another_file_is_not_believed(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    path.write_bytes(find_people(whole / "shards")[0].read_bytes())
    index_path(path).write_bytes(b"PK not an index")
    assert len(Shard(path)) == 8
    write_index(path, open_index(path))
    with path.open("ab") as file:
        file.write(b"\0" * 512)
    assert len(Shard(path)) == 8
    path.write_bytes(path.read_bytes()[:50_000])
    with pytest.raises(DataError, match=r"a\.tar"):
        Shard(path)


def test_a_writer_writes_what_tarfile_writes(tmp_path: Path) -> None:
    entries = [("a.canonical.npz", b"x" * 700), ("a.json", b"{}"), ("a_0.png", b""), ("a_0.json", b"y" * 512)]
    write_shard(tmp_path / "a.tar", entries)
    with ShardWriter(tmp_path / "b.tar", "json") as writer:
        for entry in entries:
            writer.add(*entry)
        writer.finish()
    assert (tmp_path / "a.tar").read_bytes() == (tmp_path / "b.tar").read_bytes()


def test_jpeg_keeps_colours() -> None:
    ramp = np.linspace(0, 255, 64).astype(np.uint8)
    pixels = np.stack(np.broadcast_arrays(ramp[None], ramp[:, None], ramp[None, ::-1]), -1)
    again = decode_colour(encode_jpeg(pixels), "ramp")
    assert np.abs(again.astype(int) - pixels).mean() < 2


def test_keeping_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UikaError, match="nothing would be kept"):
        synthesize(Synthesis(tmp_path, 1, captures=False, archives=False), progress=False)
