"""Decoder of the facial correspondence estimator: tokens of four depths into a UV map (supplement A.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from uika.model.config import EstimatorConfig
from uika.model.dpt import RefineBlock, resize_corners, resize_layers, token_map

_POSITION_BASE = 100.0
_POSITION_SHARE = 0.1
_OUTPUT_WIDTH = 32
_VIEWS_AT_ONCE = 4


def grid_positions(rows: int, columns: int, channels: int, aspect: float, device: torch.device) -> Tensor:
    """Sine-cosine embedding [channels,rows,columns] of a grid whose diagonal has length 2; x first, then y.

    `aspect` is the width of the picture over its height.
    """
    diagonal = math.hypot(aspect, 1.0)
    frequencies = _POSITION_BASE ** (-torch.arange(channels // 4, dtype=torch.float64, device=device) / (channels / 4))
    lines = []
    for count, span in ((columns, aspect / diagonal), (rows, 1.0 / diagonal)):
        edge = span * (count - 1) / count
        angles = frequencies[:, None] * torch.linspace(-edge, edge, count, dtype=torch.float32, device=device).double()
        lines.append(torch.cat([angles.sin(), angles.cos()]))
    across = lines[0][:, None, :].expand(-1, rows, -1)
    down = lines[1][:, :, None].expand(-1, -1, columns)
    return torch.cat([across, down]).float()


class UvHead(nn.Module):
    """Dense prediction head; its last channel, a confidence, is not returned."""

    def __init__(self, config: EstimatorConfig) -> None:
        """See `EstimatorConfig`."""
        super().__init__()
        dim, features, channels = 2 * config.backbone.dim, config.features, config.channels
        self.patch_size = config.backbone.patch_size
        self.norm = nn.LayerNorm(dim)
        self.projects = nn.ModuleList(nn.Conv2d(dim, width, 1) for width in channels)
        self.resize_layers = resize_layers(channels)
        self.scratch = nn.Module()
        for level, width in enumerate(channels, start=1):
            self.scratch.add_module(f"layer{level}_rn", nn.Conv2d(width, features, 3, padding=1, bias=False))
            block = RefineBlock(features, deepest=level == 4, released_estimator=True)
            self.scratch.add_module(f"refinenet{level}", block)
        self.scratch.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.scratch.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, _OUTPUT_WIDTH, 3, padding=1), nn.ReLU(), nn.Conv2d(_OUTPUT_WIDTH, 3, 1)
        )

    def forward(self, tokens: list[Tensor], grid: tuple[int, int]) -> Tensor:
        """Four [B,V,h*w,C] of grid (h, w), shallow to deep -> UV maps [B,V,2,h*p,w*p] in (0,1)."""
        batch, views = tokens[0].shape[:2]
        flat = [level.flatten(0, 1) for level in tokens]
        # Views do not meet here: a few at a time bound the memory of the full-size maps.
        parts = [
            self._decode([level[first : first + _VIEWS_AT_ONCE] for level in flat], grid)
            for first in range(0, batch * views, _VIEWS_AT_ONCE)
        ]
        return torch.cat(parts).sigmoid().unflatten(0, (batch, views))

    def _decode(self, tokens: list[Tensor], grid: tuple[int, int]) -> Tensor:
        aspect = grid[1] / grid[0]
        levels = []
        for level, project, scale, name in zip(tokens, self.projects, self.resize_layers, "1234", strict=True):
            x = project(token_map(self.norm(level), grid))
            levels.append(self._part(f"layer{name}_rn")(scale(_placed(x, aspect))))
        x = levels[3]
        for name in "4321":
            index = int(name) - 1
            below = levels[index - 1].shape if index else (0, 0, 2 * levels[0].shape[2], 2 * levels[0].shape[3])
            x = self._part(f"refinenet{name}")(x, None if name == "4" else levels[index], (below[2], below[3]))
        x = self._part("output_conv1")(x)
        x = resize_corners(x, (grid[0] * self.patch_size, grid[1] * self.patch_size))
        return self._part("output_conv2")(_placed(x, aspect))[:, :2]

    def _part(self, name: str) -> nn.Module:
        return self.scratch.get_submodule(name)


def _placed(x: Tensor, aspect: float) -> Tensor:
    rows, columns = x.shape[-2:]
    return x + _POSITION_SHARE * grid_positions(rows, columns, x.shape[1], aspect, x.device).to(x.dtype)
