"""What training costs, and that it survives: `python -m benchmarks.training --data PEOPLE`.

One run is left alone, another with the same settings is killed (SIGKILL) at random moments and continued. Their losses
are drawn over each other; the memory of the first is watched and its steps are split by stage. Then two gloo processes
train beside one with the same heads a step.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import RESULTS, markdown, save
from uika.train.logbook import STAGES, read_log

SAVE_EVERY = 10
SIZE = 128


def command(data: Path, folder: Path, steps: int, images: int) -> list[str]:
    """The command line of a training."""
    words = ["-m", "uika", "train", "--preset", "tiny", "--data", str(data), "--steps", str(steps), "-o", str(folder)]
    return [*words, "--size", str(SIZE), "--images", str(images), "--save-every", str(SAVE_EVERY), "--resume"]


def steps_done(log: Path) -> int:
    """Lines of a log that may be written to at the same moment."""
    return log.read_bytes().count(b"\n") if log.exists() else 0


def start(words: Sequence[str]) -> subprocess.Popen[bytes]:
    """A training in a process group of its own."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    # Two runs that nobody kills drift apart less with one thread of torch than with several.
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, *words], start_new_session=True, env=environment, **quiet)  # type: ignore[call-overload, no-any-return]


def watched(words: Sequence[str], log: Path) -> list[tuple[int, float]]:
    """Run to the end; (steps done, resident MiB of the trainer) every second."""
    process, seen = start(words), []
    while process.poll() is None:
        time.sleep(1)
        status = Path(f"/proc/{process.pid}/statm")
        pages = int(status.read_text().split()[1]) if status.exists() else 0
        if pages:  # an ending process has none
            seen.append((steps_done(log), pages * os.sysconf("SC_PAGESIZE") / 2**20))
    if process.returncode:
        raise SystemExit(f"training failed with {process.returncode}: {' '.join(words)}")
    return seen


def interrupted(words: Sequence[str], log: Path, steps: int, kills: int) -> list[int]:
    """Run to the end with `kills` SIGKILLs on the way; the steps at which they came."""
    chance, struck = random.Random(0), []
    for _ in range(kills):
        done = steps_done(log)
        goal = chance.randint(done + 5, done + (steps - done) // 2)
        process = start(words)
        while process.poll() is None and steps_done(log) < goal:
            time.sleep(0.2)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            struck.append(steps_done(log))
    watched(words, log)
    return struck


def side_by_side(folder: Path, data: Path) -> list[dict[str, object]]:
    """Losses of two processes with one head each, and of one process with two heads."""
    code = "\n".join([
        "import sys", "from dataclasses import replace", "from pathlib import Path",
        "from uika.train import TRAINING, Setup, Stored, join_group, leave_group, train",
        "heads = int(sys.argv[3])",
        "config = replace(TRAINING['tiny'], steps=4, sources=1, images=heads, items=heads, size=128, warmup=1)",
        "people = Stored([Path(sys.argv[2])])", "group = join_group('cpu')",
        "train(config, people, Setup(Path(sys.argv[1]), workers=0, progress=False), group)", "leave_group()",
    ])  # fmt: skip
    script = folder / "side_by_side.py"
    script.write_text(code)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    two = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    for words, name, heads in ((two, "two", "1"), ([], "one", "2")):
        subprocess.run(
            [sys.executable, *words, str(script), str(folder / name), str(data), heads], env=environment, check=True
        )
    pairs = zip(read_log(folder / "one"), read_log(folder / "two"), strict=True)
    return [
        {"step": a["step"], "one process": f"{a['loss']:.7f}", "two processes": f"{b['loss']:.7f}",
         "relative difference": f"{abs(a['loss'] - b['loss']) / a['loss']:.1e}"} for a, b in pairs
    ]  # fmt: skip


def split(log: Sequence[dict[str, Any]]) -> list[dict[str, object]]:
    """Seconds of the stages of a step by number of heads."""
    rows = []
    for heads in sorted({line["heads"] for line in log}):
        own = [line for line in log if line["heads"] == heads]
        medians = {stage: statistics.median(line[f"seconds_{stage}"] for line in own) for stage in STAGES}
        row: dict[str, object] = {"heads": heads, "steps": len(own)}
        row |= {name.replace("_", " "): round(value, 3) for name, value in medians.items()}
        rows.append(row | {"heads/s": round(heads / sum(medians.values()), 2)})
    return rows


def draw(
    whole: Sequence[dict[str, Any]],
    cut: Sequence[dict[str, Any]],
    kills: Sequence[int],
    memory: Sequence[tuple[int, float]],
) -> None:
    """Both loss curves, and the memory of the run that was left alone."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 4), layout="constrained")
    curves, store = drawing.subplots(1, 2)
    curves.plot([r["step"] for r in whole], [r["loss"] for r in whole], lw=3, alpha=0.4, label="left alone")
    curves.plot([r["step"] for r in cut], [r["loss"] for r in cut], lw=1, color="black", label="killed and continued")
    for step in kills:
        curves.axvline(step, color="tab:red", ls=":", label="SIGKILL" if step == kills[0] else None)
    curves.set(xlabel="step", ylabel="loss")
    curves.legend()
    store.plot([step for step, _ in memory], [size for _, size in memory])
    store.set(xlabel="step", ylabel="resident memory of the trainer, MiB", ylim=(0, None))
    drawing.savefig(RESULTS / "training.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="captures or shards")
    parser.add_argument("--steps", type=int, default=60, help="of the runs that are compared")
    parser.add_argument("--long", type=int, default=500, help="steps over which memory is watched")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole, cut, long = (folder / each for each in ("whole", "cut", "long"))
        watched(command(options.data, whole, options.steps, 2), whole / "log.jsonl")
        kills = interrupted(command(options.data, cut, options.steps, 2), cut / "log.jsonl", options.steps, 3)
        memory = watched(command(options.data, long, options.long, 1), long / "log.jsonl")
        equal = side_by_side(folder, options.data)
        logs = [read_log(each) for each in (whole, cut, long)]
    draw(logs[0], logs[1], kills, memory)
    differences = [abs(a["loss"] - b["loss"]) / a["loss"] for a, b in zip(logs[0], logs[1], strict=True)]
    untouched = kills[0] // SAVE_EVERY * SAVE_EVERY  # steps that the first process took and nobody took again
    tenth = [size for step, size in memory if step >= options.long // 10]
    text = (
        f"Killed at steps {', '.join(map(str, kills))} and continued: the losses of all {options.steps} steps equal "
        f"those of the run left alone to a relative {max(differences):.1e}. Sums in another order make two runs drift "
        f"apart that nobody kills: over the {untouched} steps before the first kill {max(differences[:untouched]):.1e}"
        ".\n\n"
        f"Memory of the trainer after a tenth of {options.long} steps {tenth[0]:.0f} MiB, at most {max(tenth):.0f} MiB"
        f", at the end {tenth[-1]:.0f} MiB.\n\n"
        f"Two gloo processes beside one with the same heads a step:\n\n{markdown(equal)}\n\n"
        f"Seconds of a step by stage, {SIZE} x {SIZE} pixels, medians:\n\n{markdown(split(logs[0]))}"
    )
    save("training", "Training", text, {"kills": kills, "memory": memory, "whole": logs[0], "cut": logs[1]})


if __name__ == "__main__":
    main()
