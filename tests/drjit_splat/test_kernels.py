"""Kernels are compiled once: sizes, cameras and values reach them as data."""

from __future__ import annotations

import drjit as dr
import torch

from .common import random_scene, render_with_gradients


def test_other_sizes_and_cameras_reuse_the_kernels() -> None:
    render_with_gradients(random_scene(count=600), 64, 64)
    other = random_scene(count=733, width=90, height=50, seed=8)
    other["viewmats"][0, :3, 3] += torch.tensor([0.1, 0.2, -0.3])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        render_with_gradients(other, 90, 50)
        launched = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(launched) > 5
    # Kernels found on disk were not in this process's memory either: the first call did not use them.
    assert [k["hash"] for k in launched if not k["cache_hit"] or k["cache_disk"]] == []
