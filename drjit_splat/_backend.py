"""The Dr.Jit backend that serves a torch device, and the few helpers every kernel uses."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr

from .llvm import require

if TYPE_CHECKING:
    import torch

F = TypeVar("F", bound=Callable[..., Any])

TILE = 4  # pixels along each side of the tile that one SIMD lane renders
PIXELS = TILE * TILE
RECORDINGS = 64  # image sizes and modes whose traced kernels are kept
# Least-squares fits with weights pushed towards equal relative errors of 2**x on [-1/2, 1/2], highest power first;
# the errors are 7.5e-8, 4e-6 and 1e-4.
_EXP2 = {
    5: (
        0.0013276428319706074,
        0.009675540985152678,
        0.05550713408587535,
        0.2402211973253605,
        0.6931469669820567,
        1.000000071652001,
    ),
    4: (0.00957010155331085, 0.05591786029169732, 0.24024744836704245, 0.6931218147418547, 0.999999261443048),
    3: (0.055171665963771745, 0.24261112196026302, 0.6932609860321195, 0.999928073568098),
}


@dataclass(frozen=True)
class Backend:
    """Array types of one Dr.Jit backend; `ad` holds the differentiable twins of the plain ones."""

    plain: Any
    ad: Any
    scatter_mode: dr.ReduceMode
    is_cpu: bool


@lru_cache(maxsize=2)
def _cpu() -> Backend:
    require()
    import drjit.llvm as plain

    return Backend(plain, plain.ad, dr.ReduceMode.Expand, True)


@lru_cache(maxsize=2)
def _cuda() -> Backend:
    if not dr.has_backend(dr.JitBackend.CUDA):
        raise RuntimeError(
            "the tensors are on a CUDA device, but Dr.Jit found no usable CUDA driver; move them to the CPU"
        )
    import drjit.cuda as plain

    return Backend(plain, plain.ad, dr.ReduceMode.Auto, False)


def backend_named(is_cpu: bool) -> Backend:
    """The LLVM backend or the CUDA backend.

    Raises:
        RuntimeError: no LLVM >= 16 (CPU) or no CUDA driver could be loaded.
    """
    return _cpu() if is_cpu else _cuda()


def backend_of(device: torch.device) -> Backend:
    """Backend for tensors on `device`.

    Raises:
        RuntimeError: no LLVM >= 16 (CPU) or no CUDA driver could be loaded.
        ValueError: the device is neither a CPU nor a CUDA device.
    """
    if device.type == "cpu":
        return _cpu()
    if device.type == "cuda":
        return _cuda()
    raise ValueError(f"tensors must be on the CPU or a CUDA device, not {device}")


def smaller(a: Any, b: Any) -> Any:
    """Lane-wise minimum; `b` where `a` is NaN, which ends there (`dr.minimum` would pass it on)."""
    return dr.select(a < b, a, b)


def larger(a: Any, b: Any) -> Any:
    """Lane-wise maximum; `b` where `a` is NaN, see `smaller`."""
    return dr.select(a > b, a, b)


def flat(kind: Any, tensor: torch.Tensor) -> Any:
    """Contiguous torch tensor -> flat Dr.Jit array on the same memory (float32, int32 or bool)."""
    return kind(tensor.detach().contiguous().view(-1))


def packet(be: Backend, source: Any, index: Any, size: int, active: Any = True) -> list[Any]:
    """The `size` (a power of two) values at `index * size` of a flat array, read at once; zeros where not active."""
    if size == 1:
        return [dr.gather(be.plain.Float, source, index, active)]
    values = dr.gather(be.plain.ArrayXf, source, index, active, shape=(size, dr.width(index)))
    return [values[i] for i in range(size)]


def write(target: Any, value: Any, index: Any, active: Any = True) -> None:
    """Write `value` to `index`, where no other lane and no other write of this kernel goes.

    The promise lets Dr.Jit keep several writes to one array in one kernel.
    """
    dr.scatter(target, value, index, active, mode=dr.ReduceMode.Permute)


def write_packet(be: Backend, target: Any, values: list[Any], index: Any) -> None:
    """Write `values` (a power of two of them) to `index * len(values)` of a flat array as one packet."""
    write(target, values[0] if len(values) == 1 else be.plain.ArrayXf(values), index)


def add_packet(be: Backend, target: Any, values: list[Any], index: Any, active: Any = True) -> None:
    """Add `values` (a power of two of them) to `index * len(values)` of a flat array, safely across threads."""
    if len(values) == 1:
        dr.scatter_add(target, values[0], index, active, mode=be.scatter_mode)
    else:
        dr.scatter_add(target, be.plain.ArrayXf(values), index, active, mode=be.scatter_mode)


def bits_of(be: Backend, value: Any) -> Any:
    """The 32 bits of each float."""
    return dr.reinterpret_array(be.plain.UInt32, value)


def exp2(be: Backend, x: Any, degree: int = 5) -> Any:
    """2**x to 1e-7 relative (with the default degree) for x < 127; everything below 2**-125 comes out as that.

    Half the instructions of `dr.exp2`, which also handles overflow and denormals.
    """
    J = be.plain
    x = larger(x, -125.0)
    whole = dr.round(x)
    f = x - whole
    leading, *rest = _EXP2[degree]
    value = J.Float(leading)
    for coefficient in rest:
        value = dr.fma(value, f, coefficient)
    return dr.reinterpret_array(J.Float, dr.reinterpret_array(J.Int32, value) + (J.Int32(whole) << 23))


_turn = threading.RLock()


def exclusive(function: F) -> F:
    """`function` for one thread at a time: Dr.Jit mixes up what several threads trace and differentiate at once."""

    @wraps(function)
    def waiting(*arguments: Any, **named: Any) -> Any:
        with _turn:
            return function(*arguments, **named)

    return cast(F, waiting)


def undisturbed(function: F) -> F:
    """`function` without collection of garbage: an array of torch's that goes while Dr.Jit records ends the process."""

    @wraps(function)
    def quiet(*arguments: Any, **named: Any) -> Any:
        if not gc.isenabled():
            return function(*arguments, **named)
        gc.disable()
        try:
            return function(*arguments, **named)
        finally:
            gc.enable()

    return cast(F, quiet)


def recorded(run: Callable[..., Any]) -> Callable[..., Any]:
    """`run`, which takes and returns arrays, traced at the first call and repeated from then on."""

    # Dr.Jit walks over everything that a frozen function's own closure names, and holds its lock meanwhile. Were there
    # a dataclass among it, the walk would run Python code, another thread could take over, and both would wait forever.
    @dr.freeze(state_fn=None, warn_after=RECORDINGS)
    def kernel(*arrays: Any) -> Any:
        return run(*arrays)

    return kernel


def power_of_two(n: int) -> int:
    """Smallest power of two >= n."""
    return 1 << max(0, n - 1).bit_length()
