"""The oracle's results of a batch from those of its elements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ._inputs import Splats


def stacked(parts: Sequence[Tensor], given: Splats) -> Tensor:
    """One tensor with the batch dimensions of the arguments."""
    return torch.stack(list(parts)).view(*given.batch, *parts[0].shape)


def batched(metas: Sequence[dict[str, Any]], given: Splats) -> dict[str, Any]:
    """Meta of all elements of the batch; `decisions` is a flat list of their cameras'."""
    return {
        name: [d for meta in metas for d in meta[name]]
        if name == "decisions"
        else stacked([meta[name] for meta in metas], given)
        for name in metas[0]
    }
