"""Time, memory and error of the network: `python -m benchmarks.model_latency --preset tiny --views 1 4 16`.

Every configuration runs the same weights on the same views of the bundled portrait's avatar. Weights are random unless
`--model` names a trained file: speed does not depend on them, errors do. Stages are timed inside one run of the whole;
processor seconds tell more than wall seconds when the machine is shared. The paper's size takes hours: `--kept FOLDER`
keeps every finished row there, and a second call goes on.
"""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.figures import lines
from benchmarks.harness import save
from uika.evaluate.latency import CONFIGURATIONS, in_order, measure_network, table
from uika.model import ESTIMATORS, computes_bfloat16


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="tiny", choices=sorted(ESTIMATORS))
    parser.add_argument("--model", help="a trained model file instead of a preset with random weights")
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32])
    parser.add_argument("--configurations", nargs="+", default=list(CONFIGURATIONS), choices=CONFIGURATIONS)
    parser.add_argument("--estimator", action="store_true", help="run the correspondence estimator too")
    parser.add_argument("--name", default="model_latency", help="of the result files")
    parser.add_argument("--kept", type=Path, help="folder for finished rows, of this preset and machine alone")
    arguments = parser.parse_args(argv)
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__},", end=" ")
    native = computes_bfloat16(torch.device("cpu"))
    print("bfloat16 arithmetic" if native else "bfloat16 weights with float32 arithmetic")
    rows = []
    measured = measure_network(
        arguments.preset,
        arguments.views,
        arguments.configurations,
        arguments.model,
        arguments.estimator,
        arguments.kept,
    )
    for row in measured:
        rows.append(row)
        print(table([row]).splitlines()[-1], flush=True)
    rows = in_order(rows)
    text = f"`{arguments.model or arguments.preset}`; stages in processor seconds.\n\n{table(rows)}"
    save(arguments.name, "Network: time, memory and error", text, {"rows": [asdict(row) for row in rows]})
    curves = {name: [(row.views, row.cpu_s) for row in rows if row.configuration == name] for name in CONFIGURATIONS}
    lines(arguments.name, {("views", "processor seconds"): {name: line for name, line in curves.items() if line}})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
