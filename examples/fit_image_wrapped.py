"""A Dr.Jit function inside a torch loop, by `drjit.wrap`: `python -m examples.fit_image_wrapped [picture]`.

Dr.Jit renders the splats and bends their colours by a curve whose exponent is learnt too.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import torch
from PIL import Image

from drjit_splat import drjit_api
from drjit_splat.interop import as_torch
from uika.assets import PORTRAIT


def curved(exponent: Any, *splats: Any, size: int) -> Any:
    """Image [1, H, W, 3] in Dr.Jit."""
    image, _ = drjit_api.rasterization(*splats, size, size)
    return dr.power(dr.maximum(image, 1e-4), exponent)


def fit(picture: Path, count: int = 4000, steps: int = 200, size: int = 256, report: int = 25) -> list[float]:
    """Mean squared error after every step; writes `fitted.png` where it runs."""
    target = torch.from_numpy(np.asarray(Image.open(picture).convert("RGB").resize((size, size)), np.float32) / 255)
    torch.manual_seed(0)
    means = torch.cat([2 * torch.rand(count, 2) - 1, torch.ones(count, 1)], 1).requires_grad_()
    quats, colors = torch.randn(count, 4).requires_grad_(), torch.rand(count, 3).requires_grad_()
    logs, logits = torch.full((count, 3), 0.02).log().requires_grad_(), torch.zeros(count, requires_grad=True)
    exponent = torch.nn.Parameter(torch.ones(1))
    Ks = torch.tensor([[[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]]])
    optimizer = torch.optim.Adam([exponent, means, quats, logs, logits, colors], lr=0.01)
    render, errors = as_torch(curved), []
    for step in range(steps):
        splats = (means, quats, logs.exp(), logits.sigmoid(), colors, torch.eye(4)[None], Ks)
        image = render(exponent, *splats, size=size)[0]
        loss = (image - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(loss.item())
        if report and step % report == 0:
            print(f"step {step}: error {errors[-1]:.5f}, exponent {exponent.item():.3f}")
    Image.fromarray((image.detach().clamp(0, 1) * 255).byte().numpy()).save("fitted.png")
    return errors


if __name__ == "__main__":
    fit(Path(sys.argv[1]) if len(sys.argv) > 1 else PORTRAIT)
