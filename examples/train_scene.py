"""Train a scene with a strategy of gsplat or of this project: `python -m examples.train_scene DATA [steps] [gsplat]`.

The loop is the one that gsplat's users know; which of the two strategies serves it is one import.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import torch

from drjit_splat import rasterization, save_ply
from drjit_splat.training import Capture, open_capture
from drjit_splat.training.similarity import psnr, ssim

RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 2.5e-3}


def strategy_of(name: str) -> Any:
    """`DefaultStrategy` with a schedule for short runs."""
    if name == "gsplat":
        from gsplat.strategy import DefaultStrategy
    else:
        from drjit_splat.strategy import DefaultStrategy
    return DefaultStrategy(refine_start_iter=100, refine_every=50, refine_stop_iter=1000, verbose=False)


def train(capture: Capture, name: str = "own", steps: int = 1000, count: int = 5000) -> dict[str, float]:
    """Train; writes `scene.ply` where it runs.

    Returns:
        `psnr` over the held-out photos, `splats`, and `ms` of a step.
    """
    torch.manual_seed(0)
    near = 0.5 * capture.extent
    params = torch.nn.ParameterDict(
        {
            "means": capture.centre + near * (2 * torch.rand(count, 3) - 1),
            "scales": torch.full((count, 3), 0.02 * near).log(),
            "quats": torch.randn(count, 4),
            "opacities": torch.full((count,), -2.0),
            "colors": torch.zeros(count, 3),  # logits
        }
    )
    optimizers = {
        key: torch.optim.Adam([value], lr=RATES[key] * (capture.extent if key == "means" else 1.0), eps=1e-15)
        for key, value in params.items()
    }
    strategy = strategy_of(name)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=capture.extent)
    pictures = [photo.pixels()[..., :3] for photo in capture.photos]

    def render(photo: Any) -> tuple[torch.Tensor, dict[str, Any]]:
        image, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"].sigmoid(),
            photo.viewmat[None],
            photo.K[None],
            photo.width,
            photo.height,
            backgrounds=torch.ones(1, 3),
            packed=False,
            absgrad=strategy.absgrad,
        )
        return image[0], info

    begun = time.perf_counter()
    for step in range(steps):
        index = int(torch.randint(len(pictures), ()))
        image, info = render(capture.photos[index])
        loss = 0.8 * (image - pictures[index]).abs().mean() + 0.2 * (1 - ssim(image, pictures[index]))
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
    ms = 1000 * (time.perf_counter() - begun) / steps
    with torch.no_grad():
        found = [psnr(render(photo)[0].clamp(0, 1), photo.pixels()[..., :3]) for photo in capture.held_out]
        opacities, colors = params["opacities"].sigmoid(), params["colors"].sigmoid()
        save_ply("scene.ply", params["means"], params["quats"], params["scales"].exp(), opacities, colors)
    return {"psnr": sum(found) / len(found), "splats": float(len(params["means"])), "ms": ms}


if __name__ == "__main__":
    given = dict(enumerate(sys.argv[1:]))
    print(train(open_capture(Path(given[0])), given.get(2, "own"), int(given.get(1, 1000))))
