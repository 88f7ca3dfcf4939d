"""What the caller's program has set is as before after this project worked in it."""

from __future__ import annotations

import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from uika.assets import HEAD, PORTRAIT
from uika.cli import main
from uika.head import HeadParameters, load_head
from uika.io.video import write_video
from uika.motion import read_json
from uika.photo.read import read
from uika.reconstruction.models import load_model
from uika.tracking import video_frames


def state() -> dict[str, Any]:
    """Settings of the process that a library could change."""
    Image.init()
    return {
        "environment": dict(os.environ),
        "signals": {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)},
        "warnings": (list(warnings.filters), warnings.showwarning),
        "torch": (
            torch.get_default_dtype(),
            torch.get_num_threads(),
            torch.is_grad_enabled(),
            torch.are_deterministic_algorithms_enabled(),
            torch.get_float32_matmul_precision(),
        ),
        "random numbers": (  # not Python's own: under pytest tyro draws from them to check itself
            torch.get_rng_state().numpy().tobytes(),
            np.random.get_state()[1].tobytes(),  # type: ignore[index,union-attr]
        ),
        "numpy": np.geterr(),
        "logging": (logging.root.level, list(logging.root.handlers)),
        "pictures": (sorted(Image.OPEN), Image.MAX_IMAGE_PIXELS),
        "process": (Path.cwd(), list(sys.path), sys.excepthook, sys.getrecursionlimit()),
    }


def read_heic(folder: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.from_pillow(Image.open(PORTRAIT).convert("RGB").resize((96, 96))).save(folder / "a.heic")
    assert read(folder / "a.heic").rgb.shape == (96, 96, 3)


def show_head(folder: Path) -> None:
    assert main(["--head", str(HEAD), "head", "show"]) == 0


def fail(folder: Path) -> None:
    assert main(["--head", str(folder / "none.npz"), "head", "show"]) == 2


def use_video(folder: Path) -> None:
    write_video(folder / "a.mp4", [torch.zeros(32, 32, 3)] * 3, 10.0)
    assert sum(1 for _ in video_frames(folder / "a.mp4")) == 3


def load_network(folder: Path) -> None:
    for name in ("tiny", "none"):
        load_model(name)


def pose(folder: Path) -> None:
    load_head().landmarks(HeadParameters.zeros(load_head()).expression.new_zeros(len(load_head().template), 3))
    (folder / "a.json").write_text('[{"jawOpen": 0.5}]')
    read_json(folder / "a.json")


@pytest.mark.parametrize("work", [read_heic, show_head, fail, use_video, load_network, pose])
def test_settings_of_the_process_are_kept(
    work: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("UIKA_HEAD", raising=False)
    work(tmp_path)  # what the first import of a package brings is the package's own
    before = state()
    work(tmp_path)
    after = state()
    assert {name for name in before if before[name] != after[name]} == set()
