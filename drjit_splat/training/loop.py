"""Train the splats of a scene, one photo a step; a run goes on exactly where it was stopped."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..rasterizer import rasterization
from ..strategy import DefaultStrategy, MCMCStrategy
from ..strategy.base import Optimizers, Parameters
from . import checkpoint, corrections, gaussians
from .captures import Capture, Photo
from .config import TrainConfig
from .processes import Processes, joined
from .similarity import psnr, ssim

SUMS = ("grad2d", "count")  # entries of the default strategy's state that add up over photos
SPLATS, LOG, FIGURES = "splats.ply", "log.jsonl", "evaluation.json"
_LOG_EVERY = 50
_SCALE_WEIGHT = _OPACITY_WEIGHT = 0.01  # of the means of scales and opacities, as MCMC wants them


@dataclass(frozen=True)
class Progress:
    """Where a run is."""

    step: int  # done
    loss: float
    psnr: float
    splats: int
    seconds: float


Watch = Callable[[Progress, dict[str, torch.nn.Parameter]], None]


def train(
    capture: Capture,
    output: str | Path,
    config: TrainConfig | None = None,
    *,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Train, evaluate on the held-out photos and write `splats.ply`, `evaluation.json`, `log.jsonl` and checkpoints.

    A folder with a checkpoint of the same settings is gone on with; its losses are those of a run that never stopped.
    Under torchrun each process learns from a photo of its own at every step, and the first one writes.

    Args:
        capture: the photos.
        output: the run's folder; made if it is missing.
        config: settings; None takes the defaults.
        watch: called after every step.

    Returns:
        The figures of `evaluation.json`: PSNR and SSIM of each held-out photo and their means, splats, steps, seconds;
        nothing in processes that do not write.

    Raises:
        ValueError: a photo or the checkpoint cannot be used, the checkpoint has other settings, or the loss is no
            longer finite; the last good checkpoint stays.
    """
    config = config or TrainConfig()
    config.check()
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    with joined() as processes:
        return _train(_Run(capture, config, checkpoint.load(folder), processes), folder, watch)


def _train(run: _Run, folder: Path, watch: Watch | None) -> dict[str, Any]:
    config, first = run.config, run.processes.first
    begun = time.perf_counter() - run.seconds
    while run.step < config.steps:
        progress = run.advance(time.perf_counter() - begun)
        if not math.isfinite(progress.loss):
            raise ValueError(
                f"{folder}: the loss is no longer finite at step {progress.step}; the last checkpoint is kept"
            )
        last = progress.step == config.steps
        if first and (progress.step % _LOG_EVERY == 0 or last):
            with (folder / LOG).open("a") as file:
                file.write(json.dumps(vars(progress)) + "\n")
        if progress.step % config.checkpoint_every == 0 or last:
            run.seconds = progress.seconds
            known = run.checkpoint()
            if first:
                checkpoint.save(folder, known)
        if first and watch is not None:
            watch(progress, run.params)
    if not first:
        return {}
    gaussians.write(run.params, folder / SPLATS)
    figures = run.evaluate() | {"steps": run.step, "splats": len(run.params["means"]), "seconds": run.seconds}
    (folder / FIGURES).write_text(json.dumps(figures, indent=1) + "\n")
    return figures


class _Run:
    """The state of a run."""

    def __init__(
        self, capture: Capture, config: TrainConfig, known: checkpoint.Checkpoint | None, processes: Processes
    ) -> None:
        if known is not None and known.config != config:
            raise ValueError(
                "the run's folder has a checkpoint of other settings; go on with the same or take another folder"
            )
        self.capture, self.config, self.extent, self.processes = capture, config, capture.extent, processes
        self.params = gaussians.start(capture, config)
        self.corrections = corrections.start(len(capture.photos), config)
        self.strategy = _strategy(config, processes)
        self.state: dict[str, Any] = (
            self.strategy.initialize_state()
            if isinstance(self.strategy, MCMCStrategy)
            else self.strategy.initialize_state(self.extent)
        )
        self.step, self.seconds = 0, 0.0
        tensors: dict[str, Tensor] = {}
        if known is not None:
            self.step, self.seconds, tensors = known.step, known.seconds, known.tensors
            for name in self.params:
                self.params[name] = torch.nn.Parameter(tensors[f"param/{name}"])
            for name in self.corrections:
                self.corrections[name] = torch.nn.Parameter(tensors[f"param/{name}"])
            self.state |= {key.removeprefix("state/"): v for key, v in tensors.items() if key.startswith("state/")}
            if not processes.first:
                for sums in self._sums():
                    sums.zero_()
        self.optimizers = gaussians.optimizers(self.params, self.extent, processes.count)
        self.correcting = corrections.optimizers(self.corrections)
        checkpoint.restore_optimizers({**self.optimizers, **self.correcting}, tensors)
        self._pictures: dict[tuple[int, int], Tensor] = {}

    def advance(self, seconds: float) -> Progress:
        """One step."""
        # Everything that is drawn depends on the step alone, so that a run can be stopped anywhere.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed * 1_000_003 + self.step)
            rate = gaussians.set_rate(self.optimizers, self.extent, self.step, self.config.steps, self.processes.count)
            index = self._photo()
            photo = self.capture.photos[index]
            shrink = self.config.shrink(self.step, min(photo.width, photo.height))
            background = torch.rand(3) if self.config.random_background else torch.ones(3)
            wanted = _over(self._picture(index, shrink), background)
            small = photo.shrunk(shrink)
            viewmat = corrections.view(small.viewmat, self.corrections, index)
            image, info = self._render(small, viewmat, background)
            shown = corrections.colors(image, self.corrections, index)
            loss = self._loss(shown, wanted)
            if isinstance(self.strategy, DefaultStrategy):
                self.strategy.step_pre_backward(self.params, self.optimizers, self.state, self.step, info)
            loss.backward()
            figures = torch.tensor([loss.item(), psnr(shown.detach().clamp(0, 1), wanted)], dtype=torch.float64)
            self.processes.average([figures])
            value, quality = figures.tolist()
            if math.isfinite(value):
                gradients = [p.grad for p in (*self.params.values(), *self.corrections.values())]
                self.processes.average([gradient for gradient in gradients if gradient is not None])
                self._update(info, rate)
        self.step += 1
        return Progress(self.step, value, quality, len(self.params["means"]), seconds)

    def _update(self, info: dict[str, Any], rate: float) -> None:
        for optimizer in (*self.optimizers.values(), *self.correcting.values()):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if isinstance(self.strategy, MCMCStrategy):
            self.strategy.step_post_backward(self.params, self.optimizers, self.state, self.step, info, rate)
        else:
            self.strategy.step_post_backward(self.params, self.optimizers, self.state, self.step, info)

    def _loss(self, shown: Tensor, wanted: Tensor) -> Tensor:
        weight = self.config.ssim_weight
        loss = (1 - weight) * (shown - wanted).abs().mean()
        loss = loss + weight * (1 - ssim(shown, wanted)) if weight else loss
        if self.config.strategy == "mcmc":
            loss = loss + _OPACITY_WEIGHT * self.params["opacities"].sigmoid().mean()
            loss = loss + _SCALE_WEIGHT * self.params["scales"].exp().mean()
        return loss

    def _render(self, photo: Photo, viewmat: Tensor, background: Tensor) -> tuple[Tensor, dict[str, Any]]:
        p = self.params
        image, _, info = rasterization(
            p["means"],
            p["quats"],
            p["scales"].exp(),
            p["opacities"].sigmoid(),
            gaussians.harmonics(p),
            viewmat[None],
            photo.K[None],
            photo.width,
            photo.height,
            sh_degree=self.config.degree(self.step),
            backgrounds=background[None],
            packed=False,
        )
        return image[0], info

    def _photo(self) -> int:
        """Which photo this step learns from: each once, in a new order every round, dealt to the processes in turn."""
        count, place = len(self.capture.photos), self.step * self.processes.count + self.processes.rank
        turn = torch.Generator().manual_seed(self.config.seed * 7919 + place // count)
        return int(torch.randperm(count, generator=turn)[place % count])

    def _picture(self, index: int, shrink: int) -> Tensor:
        if (index, shrink) not in self._pictures:
            self._pictures = {key: value for key, value in self._pictures.items() if key[1] == shrink}
            pixels = self.capture.photos[index].pixels(shrink)
            self._pictures[index, shrink] = (pixels * 255).round().byte()
        return self._pictures[index, shrink].float() / 255

    @torch.no_grad()
    def evaluate(self) -> dict[str, Any]:
        """Figures of the held-out photos, on white."""
        rows = {}
        for photo in self.capture.held_out:
            image, _ = self._render(photo, photo.viewmat, torch.ones(3))
            wanted, image = _over(photo.pixels(), torch.ones(3)), image.clamp(0, 1)
            rows[photo.path.name] = {"psnr": psnr(image, wanted), "ssim": float(ssim(image, wanted))}
        means = {
            name: sum(row[name] for row in rows.values()) / len(rows) if rows else None for name in ("psnr", "ssim")
        }
        return {**means, "held_out": rows}

    def _sums(self) -> list[Tensor]:
        """What the strategy has added up over the photos."""
        return [value for name in SUMS if isinstance(value := self.state.get(name), Tensor)]

    def checkpoint(self) -> checkpoint.Checkpoint:
        """All that the rest of the run depends on; every process must ask."""
        self.processes.add_up(self._sums(), keep=False)
        tensors: dict[str, Tensor] = {
            f"param/{name}": value for name, value in (*self.params.items(), *self.corrections.items())
        }
        tensors |= {f"state/{name}": v for name, v in self.state.items() if isinstance(v, Tensor)}
        tensors |= checkpoint.optimizer_tensors({**self.optimizers, **self.correcting})
        return checkpoint.Checkpoint(self.step, self.seconds, self.config, tensors)


class _Bounded(DefaultStrategy):
    """The strategy over what all processes have seen, with a largest number of Gaussians.

    Where there is less room than the image asks for, those that it pulls at most get it. To let all of them grow and
    remove the faintest again would undo a part of the scene at every refinement.
    """

    processes = Processes()
    max_splats = 0

    def _grow(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int) -> tuple[int, int]:
        self.processes.add_up([state[name] for name in SUMS], keep=True)
        pulled = state["grad2d"] / state["count"].clamp_min(1)
        room = self.max_splats - len(pulled)
        if room <= 0:
            return 0, 0
        usual = self.grow_grad2d
        if int((pulled > usual).sum()) > room:  # each adds one
            self.grow_grad2d = float(pulled.topk(room + 1).values[-1])
        try:
            return super()._grow(params, optimizers, state, step)
        finally:
            self.grow_grad2d = usual


def _strategy(config: TrainConfig, processes: Processes) -> DefaultStrategy | MCMCStrategy:
    """The strategy with its schedule in shares of the run: 3DGS's own is made for 30,000 steps."""
    begin, every = min(500, config.steps // 14), max(1, min(100, config.steps // 70))
    if config.strategy == "mcmc":
        stop = max(begin + 1, int(0.8 * config.steps))
        return MCMCStrategy(config.max_splats, refine_start_iter=begin, refine_stop_iter=stop, refine_every=every)
    stop = max(begin + 1, config.steps // 2)
    strategy = _Bounded(
        refine_start_iter=begin, refine_stop_iter=stop, refine_every=every, reset_every=max(3000, config.steps // 5)
    )
    strategy.processes, strategy.max_splats = processes, config.max_splats
    return strategy


def _over(pixels: Tensor, background: Tensor) -> Tensor:
    """Pixels [H,W,4] on a colour [3]."""
    return torch.lerp(background.expand_as(pixels[..., :3]), pixels[..., :3], pixels[..., 3:])


def read_log(folder: str | Path) -> Iterator[Progress]:
    """The progress that a run has noted."""
    with (Path(folder) / LOG).open() as file:
        yield from (Progress(**json.loads(line)) for line in file)
