"""Training by several processes (torchrun): each learns from photos of its own, and all hold the same splats."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Processes:
    """This process among those of a run."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this one writes the files."""
        return self.rank == 0

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Put the mean over all processes into each tensor; the same bits everywhere."""
        if self.count == 1 or not tensors:
            return
        whole = torch.cat([tensor.reshape(-1) for tensor in tensors])
        torch.distributed.all_reduce(whole)
        parts = (whole / self.count).split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    def add_up(self, tensors: Sequence[Tensor], *, keep: bool) -> None:
        """Put the sum over all processes into each tensor; zeros everywhere but in the first unless they `keep` it."""
        if self.count == 1:
            return
        for tensor in tensors:
            torch.distributed.all_reduce(tensor)
            if not (keep or self.first):
                tensor.zero_()


@contextmanager
def joined() -> Iterator[Processes]:
    """The processes that torchrun has started; a single one without it."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Processes()
        return
    ours = not torch.distributed.is_initialized()
    if ours:
        torch.distributed.init_process_group("gloo")
    try:
        yield Processes(torch.distributed.get_rank(), torch.distributed.get_world_size())
    finally:
        if ours:
            torch.distributed.destroy_process_group()
