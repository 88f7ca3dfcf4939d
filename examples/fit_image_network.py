"""A torch network inside a Dr.Jit loop, by `drjit.wrap`: `python -m examples.fit_image_network [picture]`.

Dr.Jit optimises the splats; their colours come from a small network that sees their places.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drjit_splat.interop import as_drjit
from drjit_splat.llvm import require
from uika.assets import PORTRAIT

require()  # before the first array: finds the LLVM library

import drjit as dr  # noqa: E402
from drjit.llvm.ad import TensorXf  # noqa: E402
from drjit.opt import Adam  # noqa: E402

from drjit_splat.drjit_api import rasterization  # noqa: E402


class Colours(torch.nn.Module):
    """Colours [N, 3] in [0, 1] of places [N, 3]."""

    def __init__(self, bands: int = 6, width: int = 64) -> None:
        """A perceptron over sines and cosines of the places."""
        super().__init__()
        self.bands = bands
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(6 * bands, width), torch.nn.ReLU(), torch.nn.Linear(width, 3), torch.nn.Sigmoid()
        )

    def forward(self, places: torch.Tensor) -> torch.Tensor:
        """Look the colours up."""
        angles = torch.cat([2.0**k * places for k in range(self.bands)], -1)
        colours: torch.Tensor = self.layers(torch.cat([angles.sin(), angles.cos()], -1))
        return colours


def fit(picture: Path, count: int = 4000, steps: int = 200, size: int = 256, report: int = 25) -> list[float]:
    """Mean squared error after every step; writes `fitted.png` where it runs."""
    target = TensorXf(np.asarray(Image.open(picture).convert("RGB").resize((size, size)), np.float32) / 255)
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    network = Colours()
    colours = as_drjit(network.forward)
    places = np.concatenate([random.uniform(-1, 1, (count, 2)), np.ones((count, 1))], 1)  # a plane one metre away
    camera = TensorXf(np.array([[[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]]], np.float32))
    view = TensorXf(np.eye(4, dtype=np.float32)[None])
    splats = Adam(lr=0.01)
    splats["means"] = TensorXf(places.astype(np.float32))
    splats["quats"] = TensorXf(random.normal(size=(count, 4)).astype(np.float32))
    splats["logs"] = TensorXf(np.full((count, 3), np.log(0.02), np.float32))
    splats["logits"] = TensorXf(np.zeros(count, np.float32))
    weights = torch.optim.Adam(network.parameters(), lr=0.01)
    errors = []
    for step in range(steps):
        weights.zero_grad()
        opacities = 1 / (1 + dr.exp(-splats["logits"]))
        means = splats["means"]
        image, _ = rasterization(
            means, splats["quats"], dr.exp(splats["logs"]), opacities, colours(means), view, camera, size, size
        )
        loss = dr.mean(dr.square(image[0] - target))
        dr.backward(loss)  # reaches the splats, and by way of torch the network's weights
        splats.step()
        weights.step()
        errors.append(float(loss.array[0]))
        if report and step % report == 0:
            print(f"step {step}: error {errors[-1]:.5f}")
    Image.fromarray((image[0].numpy().clip(0, 1) * 255).astype(np.uint8)).save("fitted.png")
    return errors


if __name__ == "__main__":
    fit(Path(sys.argv[1]) if len(sys.argv) > 1 else PORTRAIT)
