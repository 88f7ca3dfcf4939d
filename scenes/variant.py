"""Starting Mitsuba on the best variant that this machine can run."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from types import ModuleType
from typing import TypeVar

from drjit_splat import llvm

FAST_VARIANT = "llvm_ad_rgb"
PLAIN_VARIANT = "scalar_rgb"
_Item = TypeVar("_Item")


@lru_cache(maxsize=1)
def _choose() -> tuple[str, str]:
    """The variant to use and, for the plain one, why the fast one cannot run."""
    try:
        llvm.require()
    except RuntimeError as error:
        return PLAIN_VARIANT, str(error)
    return FAST_VARIANT, ""


def load_mitsuba() -> ModuleType:
    """Import Mitsuba with `llvm_ad_rgb` selected, or `scalar_rgb` with a warning where LLVM is missing.

    Raises:
        ImportError: Mitsuba is not installed.
    """
    variant, reason = _choose()
    try:
        import mitsuba
    except ImportError as error:
        raise ImportError(
            "reference renders need Mitsuba: install the extra with `pip install uika-drjit[scenes]`"
        ) from error
    if mitsuba.variant() != variant:
        mitsuba.set_variant(variant)
        if reason:
            warnings.warn(f"Mitsuba runs on {variant}, without depth, uv and triangle images: {reason}", stacklevel=2)
    return mitsuba


@contextmanager
def keeping_variant() -> Iterator[None]:
    """Mitsuba's variant afterwards is what it was before, if the caller had chosen one; also a decorator.

    The variant belongs to the whole process: a caller's own scene would stop rendering on another one.
    """
    before = sys.modules["mitsuba"].variant() if "mitsuba" in sys.modules else None
    try:
        yield
    finally:
        if before is not None and (mitsuba := sys.modules["mitsuba"]).variant() != before:
            mitsuba.set_variant(before)


def step_by_step(items: Iterator[_Item]) -> Iterator[_Item]:
    """The same items; each is made with this project's variant, and handed out with the caller's."""
    while True:
        with keeping_variant():
            load_mitsuba()
            try:
                item = next(items)
            except StopIteration:
                return
        yield item


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let Dr.Jit and Mitsuba work in one thread.

    Several threads build a ray tracing hierarchy in an order that chance decides, and with it which of two triangles a
    ray on their common edge hits.
    """
    if load_mitsuba().variant() != FAST_VARIANT:
        yield
        return
    import drjit as dr

    count = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(count)
