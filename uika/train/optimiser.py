"""The optimiser, its decay rule and schedule, and the running mean of the weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from uika.train.config import TrainConfig


def make_optimizer(network: nn.Module, config: TrainConfig) -> torch.optim.Optimizer:
    """AdamW or Adam; weight decay spares LayerNorms and all biases, as in the released training."""
    decayed: list[nn.Parameter] = []
    spared: list[nn.Parameter] = []
    for module in network.modules():
        for name, parameter in module.named_parameters(recurse=False):
            if parameter.requires_grad:
                (spared if isinstance(module, nn.LayerNorm) or name.endswith("bias") else decayed).append(parameter)
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": spared, "weight_decay": 0.0}]
    if config.optimizer == "adam":
        groups[0]["weight_decay"] = 0.0  # Adam's own decay is no decay but a penalty that the moments rescale
        return torch.optim.Adam(groups, lr=config.learning_rate, betas=config.betas)
    return torch.optim.AdamW(groups, lr=config.learning_rate, betas=config.betas)


def trained(network: nn.Module) -> dict[str, nn.Parameter]:
    """Parameters with gradients by name."""
    return {name: parameter for name, parameter in network.named_parameters() if parameter.requires_grad}


class RunningMean:
    """Exponential mean of the weights, which is what gets used in the end."""

    def __init__(self, network: nn.Module, keep: float) -> None:
        """Start at the weights as they are; `keep` 0 follows them exactly."""
        self._keep = keep
        self.values: dict[str, Tensor] = {
            name: parameter.detach().clone() for name, parameter in trained(network).items()
        }

    @torch.no_grad()
    def update(self, network: nn.Module, updates: int) -> None:
        """Take in the weights after `updates` steps; early steps count more, so that the start is soon forgotten."""
        keep = min(self._keep, (1 + updates) / (10 + updates)) if self._keep else 0.0
        for name, parameter in trained(network).items():
            self.values[name].lerp_(parameter.detach(), 1 - keep)


def learning_rate(step: int, base: float, warmup: int, steps: int) -> float:
    """Rate of optimiser step `step` (0-based): linear warm-up, then a half cosine that is 0 in the last of `steps`."""
    if step < warmup:
        return base * (step + 1) / warmup
    if step >= steps - 1:
        return 0.0
    return base * 0.5 * (1 + math.cos(math.pi * (step + 1 - warmup) / (steps - warmup)))


def batch_size(sources: int, images: int = 16, most: int = 8) -> int:
    """Heads per process and step when each has `sources` photos: a fixed budget of `images`, at most `most` heads.

    The defaults are the released ones of the reconstructor; the estimator has 48 and 16.
    """
    return min(max(1, images // sources), most)
