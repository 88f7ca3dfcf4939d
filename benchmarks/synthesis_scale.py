"""What the paper's number of synthetic images costs: 7,500 people with 13,005 images (9 views of 1,445 moments).

Run `python -m benchmarks.synthesis_scale`; writes `benchmarks/results/synthesis_scale.{json,md,png}`. Seconds are those
of the processor, so that other programs on the machine hardly count; machines are ones with two such cores.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.figures import bars
from benchmarks.harness import markdown, save
from uika.data import Synthesis, synthesize
from uika.data.datasets import Shard
from uika.data.shard_index import index_path
from uika.data.shard_writer import ShardWriter
from uika.data.shards import read_shard

PEOPLE, VIEWS, MOMENTS = 7500, 9, 1445
IMAGES = PEOPLE * VIEWS * MOMENTS
CORES, MACHINES = 2, 100
FORMS: dict[str, dict[str, Any]] = {
    "files and shards, png, labels": {},
    "shards, png, labels": {"captures": False},
    "shards, jpeg, no labels": {"captures": False, "images": "jpeg", "labels": "tracked"},
}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--moments", type=int, default=12)
    parser.add_argument("--opened", type=int, nargs="+", default=[1000, 13_005, 117_000])
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        made = [made_as(name, Path(folder), options.size, options.moments) for name in FORMS]
        slim = Path(folder) / "2" / "shards" / "000000.tar"
        opened = [opening(slim, Path(folder) / "long.tar", count) for count in options.opened]
    text = (
        f"One person, {VIEWS} views, {options.moments} moments at {options.size} x {options.size}; the last columns "
        f"are {PEOPLE:,} people x {VIEWS} views x {MOMENTS:,} moments = {IMAGES / 1e6:.1f} M images at the same "
        f"rate, with {MACHINES} machines of {CORES} cores.\n\n{markdown(made)}\n\n"
        f"Opening a person's shard, and reading one image out of it:\n\n{markdown(opened)}"
    )
    save("synthesis_scale", "Synthetic data at the paper's scale", text, {"made": made, "opened": opened})
    bars(
        "synthesis_scale",
        {"terabytes": {"whole set": {row["form"]: row["TB"] for row in made}}},
        "TB of all images",
    )


def made_as(name: str, folder: Path, size: int, moments: int) -> dict[str, Any]:
    """One form of a set: cost of an image, and of all."""
    place = folder / str(list(FORMS).index(name))
    synthesize(Synthesis(folder / f"warm {name}", 1, VIEWS, 1, size, seed=2, **FORMS[name]), progress=False)
    start = time.process_time()
    images = synthesize(Synthesis(place, 1, VIEWS, moments, size, seed=1, **FORMS[name]), progress=False).images
    seconds = (time.process_time() - start) / images
    stored = sum(path.stat().st_size for path in place.rglob("*") if path.is_file()) / images
    days = IMAGES * seconds / CORES / 86_400
    return {
        "form": name,
        "cpu ms per image": round(1e3 * seconds, 1),
        f"images/s on {CORES} cores": round(CORES / seconds, 1),
        "kB per image": round(stored / 1e3, 1),
        "TB": round(stored * IMAGES / 1e12, 2),
        "days of one machine": round(days),
        f"days of {MACHINES}": round(days / MACHINES, 2),
    }


def opening(source: Path, target: Path, count: int) -> dict[str, Any]:
    """Seconds to open a shard of `count` images and to read one, with its index and without."""
    groups = list(read_shard(source))
    shared, samples = groups[0], groups[1:]
    with ShardWriter(target, "json") as writer:
        for extension, data in shared[1].items():
            writer.add(f"{shared[0]}.{extension}", data)
        for number in range(count):
            for extension, data in samples[number % len(samples)][1].items():
                # Nothing but the headers is read to open it.
                writer.add(f"000000_{number // VIEWS:05d}_{number % VIEWS:02d}.{extension}", data[:600])
        writer.finish()
    indexed = _seconds(target)
    index = index_path(target)
    size = index.stat().st_size
    index.unlink()
    return {
        "images": count,
        "s with index": round(indexed, 3),
        "s without": round(_seconds(target), 3),
        "MB of index": round(size / 1e6, 2),
    }


def _seconds(path: Path) -> float:
    start = time.process_time()
    Shard(path)
    return time.process_time() - start


if __name__ == "__main__":
    main()
