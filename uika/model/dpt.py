"""UV decoder trunk: four token depths refined into one feature map, with the aggregate at every level (section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.model.config import ModelConfig


class ResidualConvUnit(nn.Module):
    """x + conv(relu(conv(relu(x)))), or with `rectified` relu(x) + the same."""

    def __init__(self, features: int, rectified: bool = False) -> None:
        """Keeps `features` channels; `rectified` is how the released estimator adds (its ReLU works in place)."""
        super().__init__()
        self.rectified = rectified
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """[B,C,h,w]."""
        positive = functional.relu(x)
        return (positive if self.rectified else x) + self.conv2(functional.relu(self.conv1(positive)))


class RefineBlock(nn.Module):
    """Adds a finer level to the running map, refines and enlarges it."""

    def __init__(self, features: int, deepest: bool, released_estimator: bool = False) -> None:
        """The deepest block starts the running map and takes no skip.

        `released_estimator`: rectified skips and corner-aligned resizing, as the released estimator has it and the
        released decoder has not.
        """
        super().__init__()
        self.corners = released_estimator
        self.resConfUnit1 = None if deepest else ResidualConvUnit(features, released_estimator)
        self.resConfUnit2 = ResidualConvUnit(features, released_estimator)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, x: Tensor, skip: Tensor | None, size: tuple[int, int]) -> Tensor:
        """x [B,C,h,w], skip of the same shape or None -> [B,C,*size]."""
        if self.resConfUnit1 is not None and skip is not None:
            x = x + self.resConfUnit1(skip)
        x = self.resConfUnit2(x)
        x = resize_corners(x, size) if self.corners else resize(x, size)
        return self.out_conv(x)


def resize(x: Tensor, size: tuple[int, int], antialias: bool = False) -> Tensor:
    """Bilinear with half-pixel centres; the same tensor if the size fits already."""
    if tuple(x.shape[-2:]) == size:
        return x
    return functional.interpolate(x, size=size, mode="bilinear", align_corners=False, antialias=antialias)


def resize_corners(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Bilinear with the corner pixels of both grids aligned."""
    return functional.interpolate(x, size=size, mode="bilinear", align_corners=True)


def token_map(tokens: Tensor, grid: tuple[int, int]) -> Tensor:
    """Tokens [B,h*w,C] of grid (h, w) as a map [B,C,h,w], channels last in memory: convolutions like it best."""
    return tokens.transpose(1, 2).unflatten(2, grid).contiguous(memory_format=torch.channels_last)


def resize_layers(channels: tuple[int, int, int, int]) -> nn.ModuleList:
    """Bring four maps of one grid to four times, twice, once and half its size."""
    return nn.ModuleList(
        [
            nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
            nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
            nn.Identity(),
            nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
        ]
    )


class UvDpt(nn.Module):
    """Tokens of four depths and the aggregate -> features at four times the token grid."""

    def __init__(self, config: ModelConfig) -> None:
        """Without `config.aggregation` the aggregate is absent; `config.surface` adds four channels."""
        super().__init__()
        observed = 4 * config.aggregation + 4 * config.surface
        features, channels = config.dpt_features, config.dpt_projections
        self.grid = config.token_grid
        self.observed = observed
        self.projects = nn.ModuleList(nn.Conv2d(config.dim, width, 1) for width in channels)
        self.resize_layers = resize_layers(channels)
        self.layer_rn = nn.ModuleList(
            nn.Conv2d(width + observed, features, 3, padding=1, bias=False) for width in channels
        )
        self.refinenet = nn.ModuleList(RefineBlock(features, deepest=index == 0) for index in range(4))
        self.output_conv = nn.Sequential(
            nn.Conv2d(features + observed, features, 3, padding=1),
            nn.LeakyReLU(0.01),
            nn.Conv2d(features, features, 3, padding=1),
        )

    def forward(self, tokens: list[Tensor], aggregate: Tensor) -> Tensor:
        """Tokens [B,grid^2,D] shallow to deep, aggregate and more [B,K,S,S] -> features [B,C,4*grid,4*grid]."""
        levels = []
        for depth, project, scale, merge in zip(tokens, self.projects, self.resize_layers, self.layer_rn, strict=True):
            level = scale(project(token_map(depth, (self.grid, self.grid))))
            levels.append(merge(self._observe(level, aggregate)))
        x: Tensor = levels[3]
        finest = (4 * self.grid, 4 * self.grid)
        for index, block in enumerate(self.refinenet):
            size = finest if index == 3 else (levels[2 - index].shape[-2], levels[2 - index].shape[-1])
            x = block(x, None if index == 0 else levels[3 - index], size)
        return self.output_conv(self._observe(x, aggregate))

    def _observe(self, level: Tensor, aggregate: Tensor) -> Tensor:
        if not self.observed:
            return level
        size = (level.shape[-2], level.shape[-1])
        observed = resize(aggregate, size, antialias=True).to(level.dtype)
        return torch.cat([level, observed.contiguous(memory_format=torch.channels_last)], dim=1)
