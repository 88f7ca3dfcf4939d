"""torch and Dr.Jit in one program by way of `drjit.wrap`, for those who compose calls of their own."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import drjit as dr
import torch
from torch import Tensor

from ._backend import exclusive
from ._bridge import torch_to_drjit
from ._compile import outside_graphs
from .llvm import require


def as_torch(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of Dr.Jit tensors as one of torch tensors, differentiated by Dr.Jit: `drjit.wrap` without its traps.

    Parameters are taken as tensors. What `drjit.wrap` gets wrong without a word is refused: a second backward pass
    (it would return the first one's gradients), inputs edited in place before the backward pass, and empty tensors (the
    process would end).

    Args:
        function: takes and returns Dr.Jit tensors, also nested in lists, tuples and dicts; other arguments pass as they
            are. It must be pure.

    Returns:
        The function, to be called outside torch.compile's graphs; not for several threads at once.
    """
    require()
    wrapped = torch_to_drjit()(function)

    @outside_graphs
    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        given: list[Tensor] = []

        def plain(value: Any) -> Any:
            if not isinstance(value, Tensor):
                return value
            if value.numel() == 0:
                raise ValueError(f"a tensor of the shape {list(value.shape)} is empty: drjit.wrap cannot pass it on")
            given.append(value)
            # drjit.wrap knows tensors by their exact type, which leaves out torch.nn.Parameter.
            return value if type(value) is Tensor else value.view_as(value)

        entering = _mapped(plain, (arguments, named))
        with torch.autocast("cpu", enabled=False):
            found = exclusive(wrapped)(*entering[0], **entering[1])
        guard = _Guard(given)
        _mapped(guard.watch, found)
        return found

    return call


def as_drjit(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of torch tensors as one of Dr.Jit tensors, differentiated by torch: `drjit.wrap` the other way.

    Gradients of parameters that the function keeps to itself, as those of a network, add up in their `.grad`.

    Args:
        function: takes and returns torch tensors, also nested in lists, tuples and dicts.
    """
    require()
    wrapped: Callable[..., Any] = dr.wrap(source="drjit", target="torch")(function)
    return wraps(function)(wrapped)


def rasterization(*arguments: Any, **named: Any) -> tuple[Tensor, Tensor]:
    """`drjit_splat.drjit_api.rasterization` for torch tensors, by `as_torch`: images and coverage, no meta.

    `drjit_splat.rasterization` does the same with one graph that may be walked twice, and takes batches.
    """
    from . import drjit_api

    found: tuple[Tensor, Tensor] = as_torch(drjit_api.rasterization)(*arguments, **named)
    return found


class _Guard:
    """Watches the backward pass of one call."""

    def __init__(self, inputs: list[Tensor]) -> None:
        self._versions = [(t, t._version) for t in inputs if not t.is_inference()]
        self._task: int | None = None

    def watch(self, result: Any) -> Any:
        """Look at every gradient that arrives at a result."""
        if isinstance(result, Tensor) and result.requires_grad:
            result.register_hook(self._check)
        return result

    def _check(self, gradient: Tensor | None) -> Tensor | None:
        task = torch._C._current_graph_task_id()
        if self._task is not None and self._task != task:
            raise RuntimeError(
                "a second backward pass through drjit.wrap would return the gradients of the first one; call the "
                "function again, or use drjit_splat.rasterization, whose graph may be walked twice"
            )
        self._task = task
        if any(t._version != version for t, version in self._versions):
            raise RuntimeError("a tensor given to drjit.wrap was modified by an inplace operation before backward")
        return None if gradient is None else gradient.contiguous()


def _mapped(function: Callable[[Any], Any], value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(_mapped(function, v) for v in value)
    if isinstance(value, dict):
        return {key: _mapped(function, v) for key, v in value.items()}
    return function(value)
