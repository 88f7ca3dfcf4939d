"""Every benchmark, one after the other: `python -m benchmarks [--quick] [NAME ...]`; `--list` says what makes what.

Each runs in a process of its own and writes NAME.json, NAME.md and NAME.png with the machine described; one that does
not is an error. With `--quick` all run on next to nothing and write to out/bench-quick: that shows that they run, and
says nothing about speed. Without it, run them with nothing else on the machine. `python -m benchmarks.compare OLD NEW`
says what changed between two JSON files. What needs people to train on (`benchmarks.training`, `benchmarks.learned`,
`benchmarks.ablations`) or a browser (`benchmarks.viewer`, `benchmarks.export`) is started by hand.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import sources

ENDINGS = (".json", ".md", ".png")
QUICK_RESULTS = Path("out") / "bench-quick"
SMALL = ("--scenes", "3k", "--repeats", "2")

# Name -> what makes it quick.
SCRIPTS: Mapping[str, Sequence[str]] = {
    "head_quality": ("--photos", "1"),
    "rasterizer_table": SMALL,
    "rasterizer_accuracy": ("--scenes", "3k", "--small", "2"),
    "rasterizer_pareto": SMALL,
    "rasterizer_skips": SMALL,
    "rasterizer_determinism": ("--quick",),
    "rasterizer_scaling": ("--quick",),
    "rasterizer_peers": SMALL,
    "animation": ("--quick",),
    "posing": ("--repeats", "2"),
    "model_latency": ("--views", "1", "--configurations", "fp32 dense"),
    "model_skipping": ("--views", "1", "--photos", "2", "--repeats", "1"),
    "model_operations": ("--preset", "tiny", "--views", "1", "2"),
    "tracking": ("--seconds", "1"),
    "fit_accuracy": ("--people", "1", "--refined", "0"),
    "mitsuba_spp": ("--size", "64", "--reference", "64", "--renders", "20"),
    "synthesis_quality": ("--sheet", "2", "--people", "1", "--size", "64"),
    "scene_validation": ("--poses", "1", "--views", "1"),
    "bust_validation": ("--poses", "1", "--views", "1"),
    "synthesis_speed": ("--sizes", "64", "--identities", "1", "--frames", "1"),
    "synthesis_scale": ("--size", "64", "--moments", "2", "--opened", "50"),
    "watermark": ("--pictures", "2", "--unmarked", "6"),
    "scene_training": (
        "--size",
        "64",
        "--spp",
        "16",
        "--steps",
        "40",
        "--splats",
        "600",
        "--folder",
        "out/bench-quick/scene",
    ),
    "endurance": ("--steps", "6", "--frames", "6"),
}


def run(name: str, quick: bool) -> float:
    """Seconds of one benchmark.

    Raises:
        SystemExit: it failed, or did not write what it must.
    """
    environment = {"OMP_WAIT_POLICY": "passive"} | os.environ
    if quick:
        environment["BENCHMARK_RESULTS"] = str(QUICK_RESULTS.resolve())
    results = Path(environment.get("BENCHMARK_RESULTS") or Path(__file__).resolve().parent / "results")
    began, start = time.time(), time.perf_counter()
    command = [sys.executable, "-m", f"benchmarks.{name}", *(SCRIPTS[name] if quick else ())]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE if quick else None, text=True)
    if done.returncode:
        raise SystemExit(f"benchmarks.{name} failed with exit code {done.returncode}\n{done.stdout or ''}")
    files = [results / f"{name}{ending}" for ending in ENDINGS]
    # A file's time may be counted in coarser steps than the clock's.
    missing = [file.name for file in files if not file.exists() or file.stat().st_mtime < began - 1]
    if missing:
        raise SystemExit(f"benchmarks.{name} did not write {', '.join(missing)}")
    return time.perf_counter() - start


def main(argv: Sequence[str] | None = None) -> None:
    """Run those named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SCRIPTS)}")
    parser.add_argument("--quick", action="store_true", help="on next to nothing, to see that they run")
    parser.add_argument("--list", action="store_true", help="print the command behind each committed result")
    arguments = parser.parse_args(argv)
    if arguments.list:
        print(sources.listing())
        return
    unknown = [name for name in arguments.names if name not in SCRIPTS]
    if unknown:
        parser.error(f"no benchmark is called {', '.join(unknown)}")
    total = 0.0
    for name in arguments.names or SCRIPTS:
        print(f"{name} ...", end=" ", flush=True)
        seconds = run(name, arguments.quick)
        total += seconds
        print(f"{seconds:.1f} s", flush=True)
    print(f"all: {total:.0f} s")


if __name__ == "__main__":
    main()
