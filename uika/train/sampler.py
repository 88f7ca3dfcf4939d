"""Which heads, how many photos and which random numbers each step gets: a function of the seed and the step alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from uika.train.optimiser import batch_size

_STREAMS = {"sources": 0, "order": 1, "item": 2}


@dataclass(frozen=True)
class Draw:
    """One head of one step."""

    step: int
    person: int  # index into the data
    sources: int  # photos to reconstruct from
    seed: int  # of everything else that is random about it


@dataclass(frozen=True)
class SamplerConfig:
    """The paper's sampler (section 3.4 and supplement B)."""

    people: int
    seed: int = 0
    most_sources: int = 16  # N_ref
    images: int = 16  # photos per process and step
    most_items: int = 8  # heads per process and step
    fixed: bool = False  # every step the same draws, to overfit them


class Sampler:
    """Batches of draws for one process of `processes`, without end.

    All processes use the same number of photos in a step, so that none waits for another. The heads of a step are
    numbered over all processes and taken in order from shuffled passes over the people: one process with a budget of 2n
    gets the same heads as two with n each.
    """

    def __init__(
        self, config: SamplerConfig, rank: int = 0, processes: int = 1, step: int = 0, cursor: int = 0
    ) -> None:
        """Start at `step`, of which `cursor` heads were taken before.

        Raises:
            ValueError: there is nobody to draw, or a limit is not positive.
        """
        if config.people < 1 or min(config.most_sources, config.images, config.most_items) < 1:
            raise ValueError(f"the sampler needs people, sources, images and items of at least 1, got {config}")
        self.config, self._rank, self._processes = config, rank, processes
        self._step, self._cursor = step, cursor

    def __iter__(self) -> Iterator[list[Draw]]:
        """Batches from the sampler's place on; the place itself does not move."""
        step, cursor = self._step, self._cursor
        while True:
            yield self.batch(step, cursor)
            cursor = self.advance(step, cursor)
            step += 1

    def sources(self, step: int) -> int:
        """Photos per head in a step, uniform in 1..N_ref."""
        drawn = 0 if self.config.fixed else step
        return int(self._random("sources", drawn).integers(1, self.config.most_sources + 1))

    def advance(self, step: int, cursor: int) -> int:
        """The cursor after a step."""
        return cursor + self._items(step) * self._processes

    def batch(self, step: int, cursor: int) -> list[Draw]:
        """This process's draws of a step."""
        items = self._items(step)
        draws = []
        for slot in range(self._rank * items, (self._rank + 1) * items):
            place, drawn = (slot, 0) if self.config.fixed else (cursor + slot, step)
            seed = int(self._random("item", drawn, slot).integers(2**62))
            draws.append(Draw(step, self._person(place), self.sources(step), seed))
        return draws

    def _items(self, step: int) -> int:
        return batch_size(self.sources(step), self.config.images, self.config.most_items)

    def _person(self, place: int) -> int:
        epoch, index = divmod(place, self.config.people)
        return int(_order(self.config.seed, epoch, self.config.people)[index])

    def _random(self, stream: str, *key: int) -> np.random.Generator:
        return _random(self.config.seed, stream, *key)


def _random(seed: int, stream: str, *key: int) -> np.random.Generator:
    return np.random.default_rng([seed, _STREAMS[stream], *key])


@lru_cache(maxsize=2)
def _order(seed: int, epoch: int, people: int) -> np.ndarray:
    return _random(seed, "order", epoch).permutation(people)
