"""Which command makes each file of `benchmarks/results` and `docs/pictures`: `python -m benchmarks --list`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = (ROOT / "benchmarks" / "results", ROOT / "docs" / "pictures")
DRAWN = "drawn by hand"

# Name of a file without its ending -> its command, where that is not `python -m benchmarks.NAME` alone.
COMMANDS: Mapping[str, str] = {
    "ablations": "python -m benchmarks.ablations --train people --data held --steps 800",
    "before_after": "python -m benchmarks.before_after",
    "export": "python -m benchmarks.export out/demo/avatar.safetensors",
    "fit_accuracy_detector": "python -m benchmarks.fit_accuracy --detector --people 2 --refined 2",
    "flow": DRAWN,
    "learned": "python -m benchmarks.learned --data held --train people",
    "model_latency_paper": "python -m benchmarks.model_latency --preset paper --name model_latency_paper",
    "page": "python tools/make_pictures.py",
    "sheet": "python tools/make_pictures.py",
    "stress_catalogue": "python -m tests.stress.report",
    "stress_faults": "python -m tests.stress.report",
    "stress_fuzz": "python -m tests.stress.report",
    "stress_fuzz_readers": "python -m tests.stress.fuzz --count 20000 --seed 2",
    "stress_scenes": "python -m tests.stress.report",
    "synthesis_people": "python -m benchmarks.synthesis_quality",
    "training": "python -m benchmarks.training --data people",
    "viewer": "python -m benchmarks.viewer",
}
_PICTURES = {"viewer.jpg": "python tools/make_pictures.py"}  # whose name without the ending is a benchmark's, too


def command(path: Path) -> str:
    """The command that makes a result or a picture, or `DRAWN`."""
    return _PICTURES.get(path.name) or COMMANDS.get(path.stem, f"python -m benchmarks.{path.stem}")


def results() -> list[Path]:
    """Every committed result and picture."""
    return sorted(path for folder in FOLDERS for path in folder.iterdir() if path.is_file())


def script(path: Path) -> Path | None:
    """The file that the command of a result runs; None for what is drawn by hand."""
    words = command(path).split()
    if words[0] != "python":
        return None
    return ROOT / words[1] if words[1] != "-m" else ROOT / (words[2].replace(".", "/") + ".py")


def listing() -> str:
    """One line for each result: its path and its command."""
    files = results()
    width = max(len(str(path.relative_to(ROOT))) for path in files)
    return "\n".join(f"{path.relative_to(ROOT)!s:{width}}  {command(path)}" for path in files)
