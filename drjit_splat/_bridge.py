"""How arrays cross between torch and Dr.Jit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
from torch import Tensor

from ._backend import Backend, flat

Kernels = Callable[..., list[Any]]
"""Takes the backend and flat Dr.Jit arrays (or None), and returns such arrays (or None)."""


def cross(be: Backend, kernels: Kernels, tensors: list[Tensor | None], wrapped: bool) -> list[Tensor | None]:
    """Call `kernels` with tensors that nobody differentiates through; the results are flat tensors.

    Both ways share memory instead of copying it. Everything happens under an `autograd.Function` that knows the
    gradients, so that neither bridge has to record anything.

    Args:
        be: the backend that serves the tensors' device.
        kernels: what to call; it gets `be` and the arrays.
        tensors: contiguous float32 tensors, or None.
        wrapped: whether `dr.wrap` carries them across, or this module does itself.
    """
    if not wrapped:
        found = kernels(be, *(None if t is None else flat(be.plain.Float, t) for t in tensors))
        return [None if a is None else a.torch() for a in found]
    found = _through_wrap(kernels)(be, *(None if t is None else t.detach() for t in tensors))
    return list(found)


def torch_to_drjit() -> Callable[..., Any]:
    """The decorator `drjit.wrap` for functions that torch calls."""
    decorator: Callable[..., Any] = dr.wrap(source="torch", target="drjit")
    return decorator


def _through_wrap(kernels: Kernels) -> Callable[..., Any]:
    def run(be: Backend, *tensors: Any) -> list[Any]:
        arrays = (None if t is None else be.plain.Float(dr.detach(t.array, False)) for t in tensors)
        return kernels(be, *arrays)

    return torch_to_drjit()(run)  # type: ignore[no-any-return]
