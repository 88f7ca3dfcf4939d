"""Public functions inside programs that torch.compile compiles."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from types import CodeType
from typing import Any, TypeVar, cast

import torch
from torch._C._dynamo import eval_frame

F = TypeVar("F", bound=Callable[..., Any])


def _skip(code: CodeType) -> None:
    """Keep the compiler from beginning with a function that it meets after it has left its caller's graph."""
    if hasattr(eval_frame, "skip_code"):  # torch < 2.6
        eval_frame.skip_code(code)
    elif hasattr(eval_frame, "set_code_exec_strategy"):
        skip, default = eval_frame._FrameAction.SKIP, eval_frame._FrameAction.DEFAULT
        eval_frame.set_code_exec_strategy(code, eval_frame._FrameExecStrategy(skip, default))


def outside_graphs(function: F) -> F:
    """`function`, at which torch.compile breaks its graph: what it calls is not traced.

    `torch.compiler.disable` alone would load the compiler, which takes longer than rendering, used or not.
    """
    disabled: list[Callable[..., Any]] = []

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        if "torch._dynamo" not in sys.modules:
            return function(*arguments, **named)
        if not disabled:
            disabled.append(torch.compiler.disable(function))
        return disabled[0](*arguments, **named)

    call._torchdynamo_disable = True  # type: ignore[attr-defined]
    _skip(cast(Any, call).__code__)
    return cast(F, call)
