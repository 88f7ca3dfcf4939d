"""Timing, machine facts and result files shared by the rasterizer's benchmarks."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

# Short trial runs go elsewhere, so that they do not replace the figures that are quoted.
RESULTS = Path(os.environ.get("BENCHMARK_RESULTS") or Path(__file__).resolve().parent / "results")


@dataclass(frozen=True)
class Timing:
    """Milliseconds of one function."""

    best: float
    median: float
    cpu: float  # least processor time over all threads

    def __str__(self) -> str:
        """Minimum / median."""
        return f"{self.best:.1f} / {self.median:.1f}"


def interleaved(
    functions: Mapping[str, Callable[[], object]], repeats: Mapping[str, int], warm: int = 2
) -> dict[str, Timing]:
    """Time every function `repeats[name]` times, taking turns, so that a slow phase of the machine meets all alike."""
    for name, function in functions.items():
        for _ in range(min(warm, repeats[name])):
            function()
    wall: dict[str, list[float]] = {name: [] for name in functions}
    cpu: dict[str, list[float]] = {name: [] for name in functions}
    rounds = max(repeats.values())
    for turn in range(rounds):
        for name, function in functions.items():
            if turn * repeats[name] // rounds == (turn + 1) * repeats[name] // rounds:
                continue
            start, used = time.perf_counter(), time.process_time()
            function()
            wall[name].append(1e3 * (time.perf_counter() - start))
            cpu[name].append(1e3 * (time.process_time() - used))
    return {name: Timing(min(wall[name]), statistics.median(wall[name]), min(cpu[name])) for name in functions}


def fastest_fma() -> float:
    """GFLOP/s of float32 multiply-adds over all of Dr.Jit's threads, as measured now."""
    import drjit as dr
    from drjit.llvm import Float, UInt32

    # Short runs of each chain in a loop: the processor then finds all ten at once, whatever order they compile to.
    chains, rounds, turns, lanes = 10, 16, 128, 1 << 15
    start = dr.opaque(Float, 1.0, lanes)
    last = dr.opaque(UInt32, turns)

    def body(turn: Any, values: list[Any]) -> tuple[Any, list[Any]]:
        for _ in range(rounds):
            values = [dr.fma(v, 0.999, 0.5) for v in values]
        return turn + 1, values

    def run() -> None:
        values = [start + float(i) for i in range(chains)]
        _, values = dr.while_loop((UInt32(0), values), lambda turn, values: turn < last, body, mode="symbolic")
        total = values[0]
        for v in values[1:]:
            total = total + v
        dr.eval(total)
        dr.sync_thread()

    timing = interleaved({"fma": run}, {"fma": 10})["fma"]
    return 2e-6 * chains * rounds * turns * lanes / timing.best


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    import drjit as dr
    import torch

    name = platform.processor() or platform.machine()
    flags = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        text = cpuinfo.read_text()
        names = [line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")]
        name = names[0] if names else name
        flags = "AVX-512" if "avx512f" in text else "AVX2" if "avx2" in text else ""
    return {
        "processor": f"{name} {flags}".strip(),
        "cores": os.cpu_count(),
        "load": [round(v, 2) for v in os.getloadavg()],
        "drjit": version("drjit"),
        "torch": torch.__version__,
        "drjit_threads": dr.thread_count(),
        "torch_threads": torch.get_num_threads(),
        "omp_wait_policy": os.environ.get("OMP_WAIT_POLICY", "not set"),
        "fma_gflops": round(fastest_fma(), 1),
    }


def markdown(rows: Sequence[Mapping[str, object]]) -> str:
    """A table of rows with the same keys."""
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(str(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def save(name: str, title: str, text: str, data: Mapping[str, Any]) -> None:
    """Write results/<name>.md and .json, and print the text."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    facts = machine()
    line = ", ".join(f"{key} {value}" for key, value in facts.items())
    page = f"# {title}\n\n{text}\n\nMachine: {line}.\n"
    (RESULTS / f"{name}.md").write_text(page)
    (RESULTS / f"{name}.json").write_text(json.dumps({"machine": facts, **data}, indent=1, default=str) + "\n")
    print(page)
