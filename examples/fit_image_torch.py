"""Fit 3D Gaussians to one picture with torch: `python -m examples.fit_image_torch [picture]`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drjit_splat import rasterization, save_ply
from uika.assets import PORTRAIT


def fit(picture: Path, count: int = 4000, steps: int = 200, size: int = 256, report: int = 25) -> list[float]:
    """Mean squared error after every step; writes `fitted.png` and `fitted.ply` where it runs."""
    pixels = np.asarray(Image.open(picture).convert("RGB").resize((size, size)), np.float32) / 255
    target = torch.from_numpy(pixels)
    torch.manual_seed(0)
    places = torch.cat([2 * torch.rand(count, 2) - 1, torch.ones(count, 1)], 1)  # a plane one metre away
    means, quats = places.requires_grad_(), torch.randn(count, 4).requires_grad_()
    logs = torch.full((count, 3), 0.02).log().requires_grad_()
    logits, colors = torch.zeros(count, requires_grad=True), torch.rand(count, 3).requires_grad_()
    camera = torch.tensor([[[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]]])
    optimizer = torch.optim.Adam([means, quats, logs, logits, colors], lr=0.01)
    errors = []
    for step in range(steps):
        splats = (means, quats, logs.exp(), logits.sigmoid(), colors)
        image, _, _ = rasterization(*splats, torch.eye(4)[None], camera, size, size)
        loss = (image[0] - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(float(loss.detach()))
        if report and step % report == 0:
            print(f"step {step}: error {errors[-1]:.5f}")
    Image.fromarray((image[0].detach().clamp(0, 1) * 255).byte().numpy()).save("fitted.png")
    save_ply("fitted.ply", *(t.detach() for t in splats))
    return errors


if __name__ == "__main__":
    fit(Path(sys.argv[1]) if len(sys.argv) > 1 else PORTRAIT)
