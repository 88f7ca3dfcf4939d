"""LPIPS (Zhang et al. 2018) with VGG-16, from a weights file that the user supplies; none comes with this project."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from uika.errors import UikaError

# Channels of the convolutions between the poolings; features are taken at the end of each stage.
_STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Lpips(nn.Module):
    """Perceptual distance of images."""

    def __init__(self, path: str | Path) -> None:
        """Read weights.

        Args:
            path: a .safetensors file with the convolutions as `features.N.weight` and `features.N.bias`, numbered as
                in torchvision's VGG-16, and the five channel weights as `lin0.weight` to `lin4.weight` (any shape of
                64, 128, 256, 512 and 512 values).

        Raises:
            UikaError: the file cannot be read or lacks a tensor.
        """
        super().__init__()
        try:
            tensors = load_file(path)
        except (OSError, SafetensorError) as error:
            raise UikaError(f"{path}: cannot be read as LPIPS weights (.safetensors): {error}") from error
        self._stages: list[list[tuple[Tensor, Tensor]]] = []
        self._gains: list[Tensor] = []
        number, channels = 0, 3
        for stage, widths in enumerate(_STAGES):
            layers = []
            for width in widths:
                weight = _take(tensors, f"features.{number}.weight", (width, channels, 3, 3), path)
                layers.append((weight, _take(tensors, f"features.{number}.bias", (width,), path)))
                number, channels = number + 2, width
            number += 1  # the pooling
            self._stages.append(layers)
            self._gains.append(_take(tensors, f"lin{stage}.weight", (1, channels, 1, 1), path))

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """Mean distance of images [N,3,H,W] in [0,1]."""
        total = image.new_zeros(())
        shift, scale = (image.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        x = (torch.cat((image, reference)) * 2 - 1 - shift) / scale
        for index, (layers, gain) in enumerate(zip(self._stages, self._gains, strict=True)):
            x = functional.max_pool2d(x, 2) if index else x
            for weight, bias in layers:
                x = functional.relu(functional.conv2d(x, weight.to(x.device), bias.to(x.device), padding=1))
            unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            first, second = unit.chunk(2)
            total = total + ((first - second).square() * gain.to(x.device)).sum(1).mean()
        return total


def _take(tensors: dict[str, Tensor], name: str, shape: tuple[int, ...], path: str | Path) -> Tensor:
    count = 1
    for side in shape:
        count *= side
    if name not in tensors or tensors[name].numel() != count:
        raise UikaError(f"{path}: lacks the LPIPS tensor '{name}' of shape {list(shape)}")
    return tensors[name].float().reshape(shape)
