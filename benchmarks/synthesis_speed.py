"""Images per second of `uika synthesize`, and where the time goes.

Run `python -m benchmarks.synthesis_speed`; a figure on busy cores is the CPU time over the number of cores.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from uika.data import Synthesis, synthesize


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 512])
    parser.add_argument("--identities", type=int, default=3)
    parser.add_argument("--frames", type=int, default=13)
    options = parser.parse_args()
    cores = os.cpu_count() or 1
    for size in options.sizes:
        with tempfile.TemporaryDirectory() as folder:
            # Another size compiles the same kernels, so that the measured run does not.
            warm = Synthesis(Path(folder) / "warm", options.identities, frames=1, size=max(16, size // 4), seed=1)
            synthesize(warm, progress=False)
            start, cpu = time.perf_counter(), time.process_time()
            settings = Synthesis(Path(folder) / "set", options.identities, frames=options.frames, size=size, seed=1)
            images = synthesize(settings, progress=False).images
            wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        print(
            f"{size:5d}^2: {images / wall:6.1f} images/s; {images * cores / cpu:6.1f} on {cores} quiet cores",
            flush=True,
        )


if __name__ == "__main__":
    main()
