"""Where the time of a call goes, and whether it compiled anything."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field

import drjit as dr


@dataclass
class Report:
    """What happened inside `profile()`; complete once the block is left."""

    stages: dict[str, float] = field(default_factory=dict)  # milliseconds, summed over all calls
    launched: int = 0  # kernels started
    compiled: int = 0  # of these, not found in the memory of this process (built, or loaded from the disk's cache)


_active: list[Report] = []


@contextmanager
def profile() -> Iterator[Report]:
    """Report the stages and kernels of every call in the block.

    Waiting for each stage before the next begins costs a little time of its own.
    """
    report = Report()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        _active.append(report)
        try:
            yield report
        finally:
            _active.remove(report)
            dr.sync_thread()
            kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            report.launched = len(kernels)
            report.compiled = sum(not k["cache_hit"] or k["cache_disk"] for k in kernels)


@contextmanager
def _timed(name: str) -> Iterator[None]:
    dr.sync_thread()
    start = time.perf_counter()
    yield
    dr.sync_thread()
    spent = 1e3 * (time.perf_counter() - start)
    for report in _active:
        report.stages[name] = report.stages.get(name, 0.0) + spent


def stage(name: str) -> AbstractContextManager[None]:
    """Account for a block of work under `name` while someone is profiling."""
    return _timed(name) if _active else nullcontext()
