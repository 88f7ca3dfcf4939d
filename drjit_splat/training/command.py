"""The command `drjit-splat train`."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

EXAMPLE = "Example: drjit-splat train garden -o out/garden --strategy mcmc"
_VIEW_EVERY = 50  # steps between pictures of the page
_CHOICES = {"strategy": ("default", "mcmc")}


def add_parser(commands: Any) -> None:
    """Add the command's options."""
    from .config import TrainConfig

    parser = commands.add_parser("train", help="train splats from photos with known cameras", description=EXAMPLE)
    parser.add_argument("data", help="a COLMAP folder, a nerfstudio transforms.json or a NeRF-synthetic folder")
    parser.add_argument("-o", "--output", required=True, help="the run's folder; one with a checkpoint is gone on with")
    default = TrainConfig()
    for field in fields(TrainConfig):
        name, value = f"--{field.name.replace('_', '-')}", getattr(default, field.name)
        if isinstance(value, bool):
            parser.add_argument(name, action=argparse.BooleanOptionalAction, default=value)
        else:
            shown = f"default: {value}"
            parser.add_argument(name, type=type(value), default=value, choices=_CHOICES.get(field.name), help=shown)
    parser.add_argument("--view", action="store_true", help="show the training on a page at 127.0.0.1 (needs viser)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Train and say what came out."""
    from .config import TrainConfig
    from .datasets import open_capture
    from .loop import SPLATS, Progress, train

    config = TrainConfig(**{field.name: getattr(arguments, field.name) for field in fields(TrainConfig)})
    config.check()
    capture = open_capture(arguments.data, config.every)
    # Of several processes the first one speaks.
    first = os.environ.get("RANK", "0") == "0"
    if first:
        print(f"{len(capture.photos)} photos to learn from, {len(capture.held_out)} held out")
    with _bar(config.steps, first) as bar, _page(arguments.view and first, capture) as page:

        def watch(progress: Progress, params: dict[str, Any]) -> None:
            if bar is not None:
                bar.update(progress.step - bar.n)
                bar.set_postfix(psnr=f"{progress.psnr:.1f}", splats=f"{progress.splats:,}", refresh=False)
            if page is not None and progress.step % _VIEW_EVERY == 0:
                page.show(params, progress)

        figures = train(capture, arguments.output, config, watch=watch)
    if not figures:
        return 0
    if figures["psnr"] is not None:
        print(f"held out: PSNR {figures['psnr']:.2f} dB, SSIM {figures['ssim']:.4f}")
    print(f"wrote {Path(arguments.output) / SPLATS}: {figures['splats']:,} splats, {figures['seconds']:.0f} s")
    return 0


@contextlib.contextmanager
def _bar(steps: int, wanted: bool) -> Iterator[Any]:
    """A progress bar on stderr, where tqdm is installed and somebody looks."""
    if not wanted:
        yield None
        return
    try:
        from tqdm import tqdm
    except ModuleNotFoundError:
        yield None
        return
    with tqdm(total=steps, desc="train", unit="step", disable=None) as bar:
        yield bar


@contextlib.contextmanager
def _page(wanted: bool, capture: Any) -> Iterator[Any]:
    if not wanted:
        yield None
        return
    from .page import TrainingPage

    page = TrainingPage(capture)
    print(f"the training is shown at {page.address}")
    try:
        yield page
    finally:
        page.close()
