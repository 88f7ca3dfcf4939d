"""Read the arrays of a model pickle without running anything that is written in it.

Old model files are pickles of numpy arrays, scipy sparse matrices and `chumpy` arrays. Unpickling calls whatever the
file names; here every name resolves to an inert record of this file or is refused, so that neither numpy's, scipy's nor
chumpy's own unpickling code runs, and none of them needs to be installed.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MAX_BYTES = 1 << 29  # of a file, and of all arrays in it; FLAME's take a fifth
_MAX_MEMO = 10_000_000  # the unpickler allocates as many slots as the largest memo index asks for
_MAX_DENSE = 1 << 22  # entries of a sparse matrix; a joint regressor has 25 thousand
_REFUSED_OPCODES = {"PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEXT_BUFFER", "READONLY_BUFFER"}
_SPARSE = ("csc", "csr", "coo")


class UnpickleError(ValueError):
    """A pickle that is damaged or holds more than arrays; the message names what was refused."""


class _Record:
    """An object of the file: what it was given, and no behaviour."""

    def __new__(cls, *arguments: Any) -> _Record:
        return object.__new__(cls)

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Record):
    """`numpy.ndarray`: state (version, shape, dtype, is_fortran, bytes)."""


class _Dtype(_Record):
    """`numpy.dtype`: arguments (code, align, copy), state (version, byte order, ...)."""


class _Chumpy(_Record):
    """`chumpy.Ch`: state {"x": array, ...}."""


class _Sparse(_Record):
    """A scipy sparse matrix in compressed columns or rows: state {"data", "indices", "indptr", "_shape", ...}."""


class _Columns(_Sparse):
    pass


class _Rows(_Sparse):
    pass


class _Entries(_Sparse):
    """A scipy sparse matrix as entries: state {"data", "row", "col"} or {"data", "coords": (row, column)}."""


class _Scalar(_Record):
    """`numpy.core.multiarray.scalar`: arguments (dtype, bytes)."""


class _Object(_Record):
    """The class `object`, which old pickles name as a base."""


class _Container(_Record):
    """A set or mapping in the bookkeeping of `chumpy`; its content is dropped."""

    def __setitem__(self, key: Any, value: Any) -> None:
        pass


class _Call:
    """A function that the file may call; unlike a plain function it cannot be given attributes by the file."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise UnpickleError("tries to change a function (opcode BUILD)")


def _make(kind: Any, *_: Any) -> _Record:
    if not (isinstance(kind, type) and issubclass(kind, _Record)):
        raise UnpickleError("asks to build an object of an unknown class")
    return kind()


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    array = _Array()
    array.state = (1, shape, dtype, order == "F", bytes(data))
    return array


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise UnpickleError("encodes text in another way than bytes are stored in")
    return text.encode("latin1")


def _no_bytes(*arguments: Any) -> bytes:
    if arguments:
        raise UnpickleError("makes bytes in another way than they are stored")
    return b""


def _globals() -> dict[tuple[str, str], Callable[..., Any]]:
    known: dict[tuple[str, str], Callable[..., Any]] = {("_codecs", "encode"): _Call(_encode)}
    for core in ("numpy.core", "numpy._core"):
        known[f"{core}.multiarray", "_reconstruct"] = _Call(_make)
        known[f"{core}.multiarray", "scalar"] = _Scalar
        known[f"{core}.numeric", "_frombuffer"] = _Call(_frombuffer)
    known["numpy", "ndarray"], known["numpy", "dtype"] = _Array, _Dtype
    for module in ("copy_reg", "copyreg"):
        known[module, "_reconstructor"] = _Call(_make)
    for module in ("__builtin__", "builtins"):
        known[module, "object"] = _Object
        known[module, "bytes"] = _Call(_no_bytes)  # how Python 3 stores an empty array for Python 2
        known[module, "set"] = known[module, "frozenset"] = _Container
    known["collections", "OrderedDict"] = known["collections", "defaultdict"] = _Container
    for module in ("chumpy", "chumpy.ch"):
        known[module, "Ch"] = _Chumpy
    for name, kind in zip(_SPARSE, (_Columns, _Rows, _Entries), strict=True):
        for module in (f"scipy.sparse.{name}", f"scipy.sparse._{name}", "scipy.sparse"):
            known[module, f"{name}_matrix"] = known[module, f"{name}_array"] = kind
    return known


_GLOBALS = _globals()


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        """The inert stand-in of a name.

        Raises:
            UnpickleError: the name is not one that array files need.
        """
        try:
            return _GLOBALS[module, name]
        except KeyError:
            raise UnpickleError(
                f"refers to '{module}.{name}'; only numpy, scipy-sparse and chumpy arrays are read"
            ) from None

    def persistent_load(self, key: Any) -> Any:
        """Refuse references to objects outside the file."""
        raise UnpickleError("refers to objects outside the file (opcode PERSID)")


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of a pickled dictionary, by name; entries that are not arrays or numbers (notes, say) are left out.

    Arrays keep their type, sparse matrices become dense, `chumpy` arrays become the array inside them.

    Raises:
        UnpickleError: the file is too large, truncated, not a pickled dictionary, or holds anything but plain values
            and arrays; the message names the class or opcode. Nothing in the file was executed.
    """
    source = Path(path)
    size = source.stat().st_size
    if size > MAX_BYTES:
        raise UnpickleError(f"{source}: has {size} bytes; model files have at most {MAX_BYTES}")
    data = source.read_bytes()
    try:
        _check_opcodes(data)
        content = _Unpickler(io.BytesIO(data), encoding="latin1").load()
        if not isinstance(content, dict):
            raise UnpickleError(f"holds a {type(content).__name__} where a dictionary of arrays is expected")
        named, total = {}, 0
        for key, value in content.items():
            named[str(key)] = _plain(value)
            total += getattr(named[str(key)], "nbytes", 0)
            if total > MAX_BYTES:  # the same stored array may be named a thousand times
                raise UnpickleError(f"holds more than {MAX_BYTES >> 20} MiB of arrays")
    except UnpickleError as error:
        raise UnpickleError(f"{source}: {error}") from error
    except Exception as error:  # a damaged pickle can fail in any way, the file's only effect is this error
        raise UnpickleError(f"{source}: is damaged or no pickle ({type(error).__name__}: {error})") from error
    return {key: value for key, value in named.items() if isinstance(value, np.ndarray)}


def _check_opcodes(data: bytes) -> None:
    """Look at every instruction before any is followed."""
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name in _REFUSED_OPCODES:
            raise UnpickleError(f"uses the opcode {opcode.name}, which array files do not need")
        if opcode.name == "GLOBAL":
            module, _, name = str(argument).partition(" ")
            if (module, name) not in _GLOBALS:
                raise UnpickleError(
                    f"refers to '{module}.{name}' (opcode GLOBAL); only numpy, scipy-sparse and chumpy arrays are read"
                )
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > _MAX_MEMO:
            raise UnpickleError(f"asks for {argument} memo slots (opcode {opcode.name})")


def _plain(value: Any) -> Any:
    """A record as an array; other values as they are."""
    if isinstance(value, _Array):
        return _array(value)
    if isinstance(value, _Scalar):
        return np.frombuffer(_bytes(value.arguments[1]), _dtype(value.arguments[0]), 1).reshape(())
    if isinstance(value, _Chumpy):
        return _chumpy(value)
    if isinstance(value, _Sparse):
        return _dense(value)
    return np.asarray(value) if isinstance(value, (bool, int, float)) else value


def _array(record: _Array) -> np.ndarray:
    _, shape, dtype, fortran, data = record.state
    kind = _dtype(dtype)
    flat = np.frombuffer(_bytes(data), kind)
    return flat.reshape(tuple(int(n) for n in shape), order="F" if fortran else "C").copy()


def _dtype(record: Any) -> np.dtype:
    """The type of a stored array: numbers only."""
    code = record.arguments[0] if isinstance(record, _Dtype) and record.arguments else None
    dtype = np.dtype(code) if isinstance(code, str) else np.dtype(object)
    if dtype.kind not in "biuf":
        raise UnpickleError(f"holds an array of type '{code}'; only numbers are read")
    order = record.state[1] if isinstance(record.state, tuple) and len(record.state) > 1 else "="
    return dtype.newbyteorder(">" if order == ">" else "<")


def _chumpy(record: _Chumpy) -> np.ndarray:
    inner = record.state.get("x") if isinstance(record.state, dict) else None
    value = _plain(inner)
    if not isinstance(value, np.ndarray):
        raise UnpickleError("holds a chumpy expression; only chumpy arrays with their values ('x') are read")
    return value


def _dense(record: _Sparse) -> np.ndarray:
    state = record.state
    shape = state.get("_shape", state.get("shape"))
    if len(shape) != 2 or not 0 <= shape[0] * shape[1] <= _MAX_DENSE or min(shape) < 0:
        raise UnpickleError(f"holds a sparse matrix of shape {shape}; larger than a head model needs")
    if isinstance(record, _Entries):
        return _from_entries(state, shape)
    data, indices, indptr = (_plain(state[name]) for name in ("data", "indices", "indptr"))
    if len(data) != len(indices) or len(indptr) < 1 or int(indptr[-1]) != len(data) or (np.diff(indptr) < 0).any():
        raise UnpickleError("holds a sparse matrix whose columns and values do not fit together")
    major = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    matrix = np.zeros(tuple(int(n) for n in shape), data.dtype)
    place = (indices, major) if isinstance(record, _Columns) else (major, indices)
    np.add.at(matrix, place, data)
    return matrix


def _from_entries(state: dict[str, Any], shape: tuple[int, int]) -> np.ndarray:
    row, column = state["coords"] if "coords" in state else (state["row"], state["col"])
    data, rows, columns = (_plain(part) for part in (state["data"], row, column))
    if not len(data) == len(rows) == len(columns):
        raise UnpickleError("holds a sparse matrix whose places and values do not fit together")
    matrix = np.zeros(tuple(int(n) for n in shape), data.dtype)
    np.add.at(matrix, (rows, columns), data)
    return matrix


def _bytes(data: Any) -> bytes:
    return data.encode("latin1") if isinstance(data, str) else bytes(data)
