"""Five scenes beside plain torch: `OMP_WAIT_POLICY=passive python -m benchmarks.rasterizer_table [--scenes 30k 130k]`.

Forward, forward + backward, stages, pairs, the floor that this machine's arithmetic sets, and peak memory. The two
implementations take turns in one process; peak memory is that of a process of its own with torch loaded.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from benchmarks import torch_baseline
from benchmarks.figures import bars
from benchmarks.harness import Timing, fastest_fma, interleaved, markdown, save
from benchmarks.splat_scenes import NAMES, QUICK, Scene, named_scene, passes
from drjit_splat import profile, rasterization

# Floating point operations of one 4x4 tile and splat: 16 pixels (recurrence 2, clamps 3, transmittance 3, colours 6;
# backward the same again without the image, and 26 more) and what a pair costs once (4 exponentials, moments).
FORWARD_FLOP = 16 * 14 + 80
BACKWARD_FLOP = 16 * (8 + 26) + 200
PASSES = ("forward", "forward + backward")
BASELINE_TURNS = {"30k": 4, "130k": 3, "500k": 1, "avatar": 2, "heavy": 0, QUICK: 1}


def functions(scene: Scene, baseline: bool) -> dict[str, Callable[[], object]]:
    """Forward and forward + backward of both implementations."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors[:5]]
    weight = torch.rand(scene.size, scene.size, 3, generator=torch.Generator().manual_seed(1))

    def torch_forward() -> None:
        with torch.no_grad():
            torch_baseline.render(*scene.tensors, scene.size)

    def torch_both() -> None:
        image = torch_baseline.render(*leaves, *scene.tensors[5:], scene.size)
        torch.autograd.grad(image, leaves, grad_outputs=weight)

    return passes(scene) | ({"torch forward": torch_forward, "torch both": torch_both} if baseline else {})


def stages(both: Callable[[], object], repeats: int) -> dict[str, float]:
    """Least milliseconds of every stage of forward + backward."""
    found: dict[str, float] = {}
    for _ in range(repeats):
        with profile() as report:
            both()
        for name, spent in report.stages.items():
            found[name] = min(spent, found.get(name, spent))
    return {name: round(spent, 2) for name, spent in found.items()}


def peak_memory(name: str) -> float:
    """MB of a process that renders and differentiates the scene a few times."""
    if name == "avatar":
        return float("nan")  # reconstructing the avatar needs more than rendering it
    command = [sys.executable, "-m", "benchmarks.rasterizer_table", "--memory-of", name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def print_memory(name: str) -> None:
    run = functions(named_scene(name), baseline=False)["both"]
    for _ in range(5):
        run()
    # `ru_maxrss` would count the process that started this one.
    status = Path("/proc/self/status").read_text()
    print(int(status.split("VmHWM:")[1].split()[0]) / 1024)


def measure(name: str, repeats: int, peak: float) -> tuple[dict[str, object], dict[str, object]]:
    """A row of the table and a row of the stages."""
    scene = named_scene(name)
    turns = BASELINE_TURNS[name]
    run = functions(scene, turns > 0)
    counts = {key: turns if key.startswith("torch") else repeats for key in run}
    times: dict[str, Timing] = interleaved(run, counts)
    with torch.no_grad():
        meta = rasterization(*scene.tensors, scene.size, scene.size)[2]
    pairs = meta["n_pairs"][0]
    worked = pairs - meta["n_culled"][0]["occluded_pairs"]
    floor = worked * FORWARD_FLOP / peak / 1e6
    row: dict[str, object] = {
        "scene": name,
        "splats": len(scene.means),
        "side": scene.size,
        "forward": times["forward"],
        "forward + backward": times["both"],
        "torch": f"{times['torch forward'].best:.0f}" if turns else "-",
        "torch f + b": f"{times['torch both'].best:.0f}" if turns else "-",
        "ratio": f"{times['torch forward'].best / times['forward'].best:.0f}x" if turns else "-",
        "ratio f + b": f"{times['torch both'].best / times['both'].best:.0f}x" if turns else "-",
        "pairs": pairs,
        "floor": f"{floor:.1f} / {floor + worked * BACKWARD_FLOP / peak / 1e6:.1f}",
        "CPU ms": f"{times['forward'].cpu:.0f} / {times['both'].cpu:.0f}",
        "peak MB": f"{peak_memory(name):.0f}",
    }
    return row, {"scene": name} | stages(run["both"], max(5, repeats // 2))


def figure(rows: list[dict[str, object]], stage_rows: list[dict[str, object]]) -> None:
    """Forward and both passes of either implementation, and the stages."""
    ours = {name: {str(r["scene"]): float(str(r[name]).split()[0]) for r in rows} for name in PASSES}
    theirs = {
        f"torch, {name}": {str(r["scene"]): float(str(r[key])) for r in rows if r[key] != "-"}
        for name, key in zip(PASSES, ("torch", "torch f + b"), strict=True)
    }
    parts = {
        name: {str(r["scene"]): float(str(r[name])) for r in stage_rows if name in r}
        for name in stage_rows[0]
        if name not in ("scene", "records")
    }
    bars("rasterizer_table", {"whole": ours | theirs, "stages": parts}, "ms, least", log=True)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=(*NAMES, QUICK), default=list(NAMES))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--memory-of", choices=(*NAMES, QUICK), help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.memory_of:
        print_memory(arguments.memory_of)
        return
    peak = fastest_fma()
    rows, stage_rows = [], []
    for name in arguments.scenes:
        row, stage_row = measure(name, arguments.repeats if name != "500k" else max(5, arguments.repeats // 2), peak)
        rows.append(row)
        stage_rows.append(stage_row)
        print(row, flush=True)
    projection = "gsplat 1.5.3's" if torch_baseline.has_gsplat() else "the oracle's (gsplat is not installed)"
    text = (
        "Milliseconds, minimum / median, through the torch API. The torch columns are vectorised torch with "
        f"{projection} projection, minimum. Floor: operations of the pairs worked on / measured multiply-add rate.\n\n"
        + markdown(rows)
        + "\n\nStages of forward + backward, minimum:\n\n"
        + markdown(stage_rows)
    )
    save("rasterizer_table", "Rasterizer: five scenes", text, {"scenes": rows, "stages": stage_rows})
    figure(rows, stage_rows)


if __name__ == "__main__":
    main()
