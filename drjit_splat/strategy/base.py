"""What every strategy offers to a training loop."""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any

import torch

Parameters = MutableMapping[str, torch.nn.Parameter] | torch.nn.ParameterDict
Optimizers = MutableMapping[str, torch.optim.Optimizer]
REQUIRED = ("means", "scales", "quats", "opacities")


@dataclass
class Strategy:
    """Base of the strategies.

    A strategy edits `params` (name -> parameter with one row a Gaussian) and the state of `optimizers` (one for each
    trainable parameter) in place: `means` [N, 3], `scales` [N, 3] as logarithms, `quats` [N, 4] wxyz, `opacities` [N]
    or [N, 1] as logits, and any others.
    """

    def check_sanity(self, params: Parameters, optimizers: Optimizers) -> None:
        """Check that the parameters and optimizers fit together.

        Raises:
            AssertionError: a name is missing, or an optimizer does not serve exactly one parameter.
        """
        trainable = {name for name, value in params.items() if value.requires_grad}
        if trainable != set(optimizers):
            raise AssertionError(
                f"every trainable parameter needs an optimizer: {sorted(trainable)}, {sorted(optimizers)}"
            )
        for name, optimizer in optimizers.items():
            groups = len(optimizer.param_groups)
            if groups != 1 or len(optimizer.param_groups[0]["params"]) != 1:
                raise AssertionError(
                    f"the optimizer of {name} must have one group with one parameter, not {groups} groups"
                )
        missing = [name for name in REQUIRED if name not in params]
        if missing:
            raise AssertionError(f"params has no {missing[0]!r}")

    def step_pre_backward(self, *arguments: Any, **named: Any) -> None:
        """Call before `loss.backward()`."""

    def step_post_backward(self, *arguments: Any, **named: Any) -> None:
        """Call after `loss.backward()`."""
