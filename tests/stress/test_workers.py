"""Calls from the workers of a loader and from several threads."""

from __future__ import annotations

import threading

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from drjit_splat import rasterization
from tests.drjit_splat.common import random_scene, render_with_gradients


class Rendered(torch.utils.data.Dataset[Tensor]):
    """Images of random scenes, rendered in the loader's worker."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> Tensor:
        # Large enough for several threads, none of which survives a fork.
        return rasterization(**random_scene(20_000, 256, 256, seed=index), width=256, height=256)[0][0]


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_of_a_loader_render_the_same(start: str) -> None:
    wanted = torch.stack([Rendered()[index] for index in range(4)])
    loader = DataLoader(Rendered(), batch_size=4, num_workers=1, multiprocessing_context=start, timeout=120)
    assert torch.equal(next(iter(loader)), wanted)


def test_threads_may_call_at_once() -> None:
    scenes = [random_scene(60, 32, 32, seed=seed) for seed in range(2)]
    wanted = [render_with_gradients(scene, 32, 32)[:2] for scene in scenes]
    problems: list[str] = []

    def work(index: int) -> None:
        try:
            for _ in range(15):
                image, gradients, _ = render_with_gradients(scenes[index], 32, 32)
                same = torch.equal(image, wanted[index][0])
                near = all(torch.allclose(g, wanted[index][1][k], rtol=1e-4, atol=1e-4) for k, g in gradients.items())
                if not same or not near:
                    problems.append(f"thread {index} got another result")
        except Exception as error:
            problems.append(repr(error))

    threads = [threading.Thread(target=work, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert problems == []
