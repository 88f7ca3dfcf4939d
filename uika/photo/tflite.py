"""The face models that come with the package, run by LiteRT."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uika.assets import FACE_MODELS
from uika.errors import UikaError, install_command

_THREADS = 4  # more gain nothing with models of this size
_STDERR_LOCK = threading.RLock()
_RUN_LOCK = threading.RLock()


def run(name: str, *inputs: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """The outputs of the model `uika/assets/face/NAME.tflite` for its inputs, in their order.

    Raises:
        UikaError: LiteRT is not installed.
    """
    with _RUN_LOCK:  # an interpreter holds one set of tensors
        interpreter = _interpreter(name)
        for given, about in zip(inputs, interpreter.get_input_details(), strict=True):
            interpreter.set_tensor(about["index"], given)
        interpreter.invoke()
        return [interpreter.get_tensor(about["index"]) for about in interpreter.get_output_details()]


@lru_cache(maxsize=8)
def _interpreter(name: str) -> Any:
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ModuleNotFoundError as error:
        raise UikaError(f"reading photos needs ai-edge-litert; run: {install_command('ai_edge_litert')}") from error
    with _native_stderr_closed():
        interpreter = Interpreter(str(FACE_MODELS / f"{name}.tflite"), num_threads=min(_THREADS, os.cpu_count() or 1))
        interpreter.allocate_tensors()
    return interpreter


@contextmanager
def _native_stderr_closed() -> Iterator[None]:
    """Point file descriptor 2 at the null device: the runtime logs there, and no variable or call stops it."""
    with _STDERR_LOCK:
        try:
            saved = os.dup(2)
        except OSError:  # a process without stderr has nothing to silence
            yield
            return
        try:
            with open(os.devnull, "wb") as null:  # noqa: PTH123
                os.dup2(null.fileno(), 2)
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
