"""Fit 3D Gaussians to one picture with Dr.Jit alone: `python -m examples.fit_image_drjit [picture]`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from drjit_splat.llvm import require
from uika.assets import PORTRAIT

require()  # before the first array: finds the LLVM library

import drjit as dr  # noqa: E402
from drjit.llvm.ad import TensorXf  # noqa: E402
from drjit.opt import Adam  # noqa: E402

from drjit_splat.drjit_api import rasterization  # noqa: E402


def fit(picture: Path, count: int = 4000, steps: int = 200, size: int = 256, report: int = 25) -> list[float]:
    """Mean squared error after every step; writes `fitted.png` where it runs."""
    target = TensorXf(np.asarray(Image.open(picture).convert("RGB").resize((size, size)), np.float32) / 255)
    random = np.random.default_rng(0)
    places = np.concatenate([random.uniform(-1, 1, (count, 2)), np.ones((count, 1))], 1)  # a plane one metre away
    camera = TensorXf(np.array([[[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]]], np.float32))
    view = TensorXf(np.eye(4, dtype=np.float32)[None])
    optimizer = Adam(lr=0.01)
    optimizer["means"] = TensorXf(places.astype(np.float32))
    optimizer["quats"] = TensorXf(random.normal(size=(count, 4)).astype(np.float32))
    optimizer["logs"] = TensorXf(np.full((count, 3), np.log(0.02), np.float32))
    optimizer["logits"] = TensorXf(np.zeros(count, np.float32))
    optimizer["colors"] = TensorXf(random.uniform(size=(count, 3)).astype(np.float32))
    errors = []
    for step in range(steps):
        opacities = 1 / (1 + dr.exp(-optimizer["logits"]))
        splats = (optimizer["means"], optimizer["quats"], dr.exp(optimizer["logs"]), opacities, optimizer["colors"])
        image, _ = rasterization(*splats, view, camera, size, size)
        loss = dr.mean(dr.square(image[0] - target))
        dr.backward(loss)
        optimizer.step()
        errors.append(float(loss.array[0]))
        if report and step % report == 0:
            print(f"step {step}: error {errors[-1]:.5f}")
    Image.fromarray((image[0].numpy().clip(0, 1) * 255).astype(np.uint8)).save("fitted.png")
    return errors


if __name__ == "__main__":
    fit(Path(sys.argv[1]) if len(sys.argv) > 1 else PORTRAIT)
