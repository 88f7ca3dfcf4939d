"""The page that shows a training is looked at in a browser."""

from __future__ import annotations

import io
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drjit_splat.training import Progress, TrainConfig, open_capture, train
from tests.chromium import Page, page
from tests.drjit_splat.training.made_up import write_colmap

pytest.importorskip("viser", reason="no viser: install the extra 'view'")
pytestmark = pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
SIDE = 480  # pixels of the browser


def picture(tab: Page) -> np.ndarray:
    """The middle of what the browser shows, in [0, 1]."""
    whole = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
    return whole[SIDE // 4 : -SIDE // 4, SIDE // 4 : -SIDE // 4] / 255


@pytest.mark.slow
def test_the_splats_appear_in_the_browser_while_they_are_trained(tmp_path: Path) -> None:
    from drjit_splat.training.page import TrainingPage

    capture = open_capture(write_colmap(tmp_path / "data", binary=True))
    config = TrainConfig(steps=250, max_splats=400, sh_degree=0, coarse_to_fine=False, strategy="mcmc")
    shown: list[np.ndarray] = []
    pages = TrainingPage(capture, port=8231)
    assert pages.address.startswith("http://127.0.0.1:")
    try:
        with page(tmp_path, SIDE, SIDE) as tab:
            tab.open(pages.address)
            tab.wait("!!document.querySelector('canvas')")

            def watch(progress: Progress, params: dict[str, torch.nn.Parameter]) -> None:
                if progress.step in (1, 250):
                    pages.show(params, progress)
                    tab.wait(f"document.body.innerText.includes('Step {progress.step}:')")
                    time.sleep(3)  # the browser's worker sorts the splats
                    shown.append(picture(tab))

            train(capture, tmp_path / "run", config, watch=watch)
            (tmp_path / "page.png").write_bytes(tab.screenshot())
    finally:
        pages.close()
    photo = capture.photos[0]
    wanted = np.asarray(Image.open(photo.path).convert("RGB").resize((SIDE, SIDE))) / 255
    wanted = wanted[SIDE // 4 : -SIDE // 4, SIDE // 4 : -SIDE // 4]
    errors = [float(np.abs(image - wanted).mean()) for image in shown]
    assert errors[1] < 0.12 and errors[1] < 0.7 * errors[0], errors
