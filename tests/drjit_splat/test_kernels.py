"""Kernels are compiled once: sizes, cameras and values reach them as data."""

from __future__ import annotations

import subprocess
import sys

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


def test_garbage_is_not_collected_while_a_kernel_is_recorded() -> None:
    code = """
import gc, torch
from drjit_splat import _blend, rasterization
from tests.drjit_splat.common import random_scene

gc.set_threshold(0)
scene = random_scene(count=50, width=16, height=16)

def fail():
    try:
        rasterization(**(scene | {"opacities": scene["opacities"] * torch.nan}), width=16, height=16)
    except ValueError as error:
        kept = error  # its frames hold arrays, and this one holds it

fail()
step = _blend.step

def busy(*arguments):  # called while the loop is recorded
    gc.set_threshold(100, 1, 1)
    many = [[] for _ in range(10000)]
    gc.set_threshold(0)
    return step(*arguments)

_blend.step = busy
print(rasterization(**scene, width=20, height=12)[0].shape, gc.isenabled())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "torch.Size([1, 12, 20, 3]) True", done.stderr
