"""LPIPS weight files with random values: of the right shapes, but without meaning."""

from pathlib import Path

import torch
from safetensors.torch import save_file

STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))


def random_weights(leave_out: str = "") -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    tensors: dict[str, torch.Tensor] = {}
    number, channels = 0, 3
    for stage, widths in enumerate(STAGES):
        for width in widths:
            scale = (2 / (9 * channels)) ** 0.5
            tensors[f"features.{number}.weight"] = scale * torch.randn(width, channels, 3, 3, generator=random)
            tensors[f"features.{number}.bias"] = torch.zeros(width)
            number, channels = number + 2, width
        number += 1
        tensors[f"lin{stage}.weight"] = torch.rand(1, channels, 1, 1, generator=random) / channels
    return {name: tensor for name, tensor in tensors.items() if name != leave_out}


def write_weights(path: Path, leave_out: str = "") -> Path:
    save_file(random_weights(leave_out), path)
    return path
