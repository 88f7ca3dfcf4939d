"""Damage files at random and watch their readers: `python -m tests.stress.fuzz --count 10000 [--targets photo ply]`.

A child process reads each damaged file with at most 1 GiB more address space than it had and 10 seconds of its own
time (or two minutes of the clock). Whatever it does besides reading or the documented refusal is a finding, and the
file that caused it is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import multiprocessing
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .targets import TARGETS

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "benchmarks" / "results" / "stress_fuzz_readers.md"
MEMORY = 1 << 30  # bytes that reading a damaged file may take at once
SECONDS = 10  # of processor time, so that a busy machine makes no findings
COLLECTED = 40  # files after which memory is tidied up: threads of PyAV's decoders live until then
PATIENCE = 120  # of the clock, for readers that sleep


class Hang(BaseException):
    """Reading took too long; no reader can mistake it for one of its own errors."""


@dataclass
class Result:
    """What became of the damaged files of one target."""

    target: str
    read: int = 0
    refused: int = 0
    slowest: float = 0.0  # seconds of processor time
    grown: int = 0  # MiB of resident memory at most, above what it was before
    findings: dict[str, str] = field(default_factory=dict)  # what happened -> file that does it

    @property
    def count(self) -> int:
        """Files tried."""
        return self.read + self.refused + len(self.findings)


def _stop(*_: Any) -> None:
    raise Hang


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _resident() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10


def _child(name: str, count: int, seed: int, folder: Path, kept: Path, pipe: Any) -> None:
    """Try `count` files; the file in work is on disk, so that a crash leaves it."""
    target = TARGETS[name]
    rng = random.Random(f"{name} {seed}")
    (folder / "seeds").mkdir()
    (folder / "work").mkdir()
    paths = target.seeds(folder / "seeds")
    good = [(path.suffix, path.read_bytes()) for path in paths]
    for path in paths:
        with contextlib.suppress(target.refusal):  # kinds that are always refused
            target.read(path)  # what it imports and keeps does not count as growth
    warnings.simplefilter("ignore")
    limit = _address_space() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    signal.signal(signal.SIGALRM, _stop)
    signal.signal(signal.SIGPROF, _stop)
    result, before, seen = Result(name), _resident(), Counter[str]()
    for index in range(count):
        if index % COLLECTED == 0:
            gc.collect()
        suffix, data = rng.choice(good)
        damaged = target.mutate(data, rng)
        path = folder / "work" / f"damaged{suffix}"
        path.write_bytes(damaged)
        started = time.process_time()
        what = ""
        signal.alarm(PATIENCE)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            target.read(path)
            result.read += 1
        except target.refusal as error:
            result.refused += 1
            if str(path) not in str(error) and str(folder / "seeds") not in str(error):
                what = f"refusal without the file's name: {_where(error)}"
                result.refused -= 1
        except BaseException as error:
            what = f"{type(error).__name__}: {_where(error)}"
        finally:
            signal.alarm(0)
            signal.setitimer(signal.ITIMER_PROF, 0)
        result.slowest = max(result.slowest, time.process_time() - started)
        seen[what] += 1
        if what and what not in result.findings:
            keep = kept / f"{name}_{seed}_{index}{suffix}"
            keep.write_bytes(damaged)
            result.findings[what] = str(keep)
        elif what:
            result.read += 1
    result.grown = max(0, _resident() - before)
    pipe.send((asdict(result), {what: number for what, number in seen.items() if what}))


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if any(part in frame.filename for part in ("/uika/", "/drjit_splat/", "/scenes/"))]
    place = own[-1] if own else frames[-1]
    return f"{Path(place.filename).name}:{place.lineno} {str(error)[:80]!r}"


def fuzz(name: str, count: int, seed: int, kept: Path) -> Result:
    """Damage and read `count` files of one target in a child process."""
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        child = context.Process(target=_child, args=(name, count, seed, folder, kept, theirs))
        child.start()
        theirs.close()
        try:
            found, _ = ours.recv()
            result = Result(**found)
        except EOFError:
            result = Result(name)
        child.join()
        if child.exitcode:
            for path in (folder / "work").glob("*"):
                keep = kept / f"{name}_{seed}_crash{path.suffix}"
                keep.write_bytes(path.read_bytes())
                result.findings[f"the process ended with {child.exitcode}"] = str(keep)
            if not result.findings:
                result.findings[f"the process ended with {child.exitcode} before the first file"] = ""
    return result


def main(argv: list[str] | None = None) -> int:
    """Print one line of JSON for each target; exit code 1 after findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--count", type=int, default=1000, help="files of each target")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kept", type=Path, default=Path("out/fuzz"), help="folder for files that cause findings")
    parser.add_argument("--table", action="store_true", help=f"write {TABLE.relative_to(ROOT)}")
    arguments = parser.parse_args(argv)
    results = []
    for name in arguments.targets:
        results.append(fuzz(name, arguments.count, arguments.seed, arguments.kept))
        print(json.dumps(asdict(results[-1]) | {"count": arguments.count}), flush=True)
    if arguments.table:
        TABLE.write_text(table(results), encoding="utf-8")
    return int(any(result.findings for result in results))


def table(results: list[Result]) -> str:
    """What became of every target, as the page on security shows it."""
    lines = [
        "# Damaged files: readers added or changed",
        "",
        f"{sum(result.count for result in results):,} damaged files.",
        "",
        "| reader | files | read | refused by name | findings | slowest, s | most memory, MiB |",
        "|" + " --- |" * 7,
    ]
    lines += [
        f"| {r.target} | {r.count:,} | {r.read:,} | {r.refused:,} | {len(r.findings)} | {r.slowest:.2f} | {r.grown} |"
        for r in sorted(results, key=lambda result: result.target)
    ]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.exit(main())
