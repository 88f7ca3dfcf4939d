"""What a training tells: a progress bar, a line per step in `log.jsonl`, curves and histograms for tensorboard."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from uika.errors import UikaError, install_command

LOG, SKIPPED = "log.jsonl", "skipped.jsonl"
STAGES = ("data", "network", "splat", "splat_backward", "network_backward", "optimiser")


class Clock:
    """Seconds of the stages of a step."""

    def __init__(self, device: torch.device) -> None:
        """On CUDA a stage ends when its kernels have."""
        self._device = device
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block."""
        start = time.perf_counter()
        yield
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """The seconds since the last time."""
        taken, self.seconds = self.seconds, {}
        return taken


class Logbook:
    """The files and the bar of a run; only the first process of a group keeps one."""

    def __init__(self, folder: Path, start: int, steps: int, visible: bool) -> None:
        """Go on at step `start`: what an interrupted run logged beyond it is dropped."""
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        _cut(folder / LOG, start)
        _cut(folder / SKIPPED, start)
        self._file = (folder / LOG).open("a")
        self._board = _board(folder / "tensorboard", start)
        self._bar = _bar(start, steps) if visible else None

    def step(self, step: int, values: Mapping[str, float], seconds: Mapping[str, float], heads: int) -> None:
        """Record a step."""
        total = sum(seconds.values())
        line = {"step": step, **values, "heads": heads, **{f"seconds_{name}": s for name, s in seconds.items()}}
        self._file.write(json.dumps({name: _short(value) for name, value in line.items()}) + "\n")
        self._file.flush()
        for name, value in values.items():
            self._board.add_scalar(name, value, step)
        for name, value in seconds.items():
            self._board.add_scalar(f"seconds/{name}", value, step)
        self._board.add_scalar("heads_per_second", heads / total, step)
        if self._bar is not None:
            shown = {name: f"{values[name]:.3g}" for name in ("loss", "psnr", "error") if name in values}
            parts = " ".join(f"{name} {100 * s / total:.0f}%" for name, s in seconds.items() if s > 0.01 * total)
            self._bar.set_postfix_str(f"{shown} {heads / total:.2f} heads/s | {parts}".translate(_PLAIN), refresh=False)
            self._bar.update()

    def histograms(self, step: int, tensors: Mapping[str, Tensor]) -> None:
        """Record distributions."""
        for name, tensor in tensors.items():
            self._board.add_histogram(name, tensor.detach().float().cpu().numpy(), step)

    def skipped(self, step: int, loss: float, keys: list[str]) -> None:
        """Record a step that was skipped, with the images it was made of."""
        with (self._folder / SKIPPED).open("a") as file:
            file.write(json.dumps({"step": step, "loss": str(loss), "images": keys}) + "\n")
        self.say(f"step {step}: loss or gradient is not finite, skipped; images: {', '.join(keys)}")
        if self._bar is not None:
            self._bar.update()

    def say(self, text: str) -> None:
        """A line for the user."""
        if self._bar is not None:
            self._bar.write(text)
        else:
            print(text)

    def close(self) -> None:
        """Finish the files."""
        self._file.close()
        self._board.close()
        if self._bar is not None:
            self._bar.close()


_PLAIN = str.maketrans("", "", "{}',")


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The steps of a run in order."""
    return [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


def _short(value: float) -> float:
    return value if isinstance(value, int) else float(f"{value:.9g}")


def _cut(path: Path, start: int) -> None:
    """Keep the lines of steps before `start`."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines():
        try:
            if json.loads(line)["step"] < start:
                kept.append(line)
        except (ValueError, KeyError):
            continue  # a line that a kill cut off
    path.write_text("".join(line + "\n" for line in kept))


def _board(folder: Path, start: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise UikaError(f"training curves need tensorboard; run: {install_command('tensorboard')}") from error
    return SummaryWriter(str(folder), purge_step=start)


def _bar(start: int, steps: int) -> Any:
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise UikaError(f"the progress bar needs tqdm; run: {install_command('tqdm')}") from error
    return tqdm(total=steps, initial=start, unit="step", desc="train", smoothing=0.1)
