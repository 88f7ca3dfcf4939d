"""One call of the rasterizer: what its images, its gradients and its meta have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ._backend import Backend, backend_of
from ._core import Trace
from ._settings import Settings

INPUTS = ("means", "quats", "scales", "covars", "opacities", "viewmats", "Ks", "radial_coeffs", "colors")
PER_SPLAT = 5  # of these the first five, once an element of the batch


@dataclass
class Pending:
    """What the second node's adjoint leaves for the first one's."""

    task: int  # of the backward pass that left it
    given: tuple[Tensor, ...]  # gradients that it passed on, of the means, conics and depths
    inputs: list[Tensor | None]  # gradients of the first node's inputs, as far as they come by way of the images


@dataclass
class Call:
    """What the two nodes of one call share. It must not keep their results, which would keep the graph alive."""

    be: Backend
    settings: Settings
    batch: tuple[int, ...]  # sizes of the batch dimensions
    cameras: int  # of each element of the batch
    packed: bool = False
    sparse: bool = False
    absgrad: bool = False
    wrapped: bool = False  # whether `dr.wrap` is the bridge
    traces: list[Trace] = field(default_factory=list)  # one an image
    asked: tuple[bool, ...] = ()  # which inputs of the first node want gradients
    looked: set[str] = field(default_factory=set)  # names of the results in between that somebody has seen
    rows: Tensor | None = None  # of a packed call's visible splats among [I * N], once they are known
    images: tuple[Tensor, Tensor] | None = None  # sums and coverage, on their way to the second node
    pending: Pending | None = None

    @property
    def batches(self) -> int:
        """Number of elements of the batch."""
        return math.prod(self.batch)

    @property
    def count(self) -> int:
        """Number of images."""
        return self.batches * self.cameras

    def of_image(self, tensors: tuple[Tensor | None, ...], i: int) -> list[Tensor | None]:
        """Those of the first node's inputs that make image `i`."""
        first = PER_SPLAT * (i // self.cameras)
        views, Ks, radial = tensors[PER_SPLAT * self.batches :]
        assert views is not None and Ks is not None
        cameras = (views[i], Ks[i], None if radial is None else radial[i])
        return [*tensors[first : first + PER_SPLAT], *cameras]


def call_for(device: torch.device, settings: Settings, batch: tuple[int, ...], cameras: int, **switches: Any) -> Call:
    """A call whose tensors are on `device`.

    Raises:
        RuntimeError: no LLVM >= 16 (CPU) or no CUDA driver could be loaded.
        ValueError: the device is neither a CPU nor a CUDA device.
    """
    return Call(backend_of(device), settings, batch, cameras, **switches)
