"""Batches of items: made on the way, by processes of their own, or read where they were prepared."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from uika.train.item import Item
from uika.train.sampler import Draw, Sampler

_PREFETCH = 4  # batches that each worker makes ahead


def batches_of(
    maker: torch.utils.data.Dataset[Item], sampler: Sampler, steps: int, workers: int
) -> Iterator[list[Item]]:
    """The items of the next steps; `workers` 0 makes them in this process."""
    from torch.utils.data import DataLoader

    order = _Order(sampler, steps)
    if sampler.config.fixed:
        same = [maker[draw] for draw in next(iter(sampler))]
        yield from (same for _ in range(steps))
        return
    if workers == 0:
        for draws in order:
            yield [maker[draw] for draw in draws]
        return
    loader = DataLoader(
        maker,
        batch_sampler=order,
        num_workers=workers,
        collate_fn=list,
        prefetch_factor=_PREFETCH,
        multiprocessing_context="spawn",  # a forked process cannot use Dr.Jit's threads
    )
    yield from loader


class _Order:
    """The draws that are left, for a loader's processes."""

    def __init__(self, sampler: Sampler, steps: int) -> None:
        self._sampler, self._steps = sampler, steps

    def __iter__(self) -> Iterator[list[Draw]]:
        for _, draws in zip(range(self._steps), self._sampler, strict=False):
            yield draws

    def __len__(self) -> int:
        return self._steps
