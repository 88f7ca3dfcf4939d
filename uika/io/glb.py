"""Binary glTF 2.0 files: a JSON document, and one buffer that its accessors point into."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uika._version import __version__
from uika.errors import UikaError
from uika.io.files import check_output, replacing

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENTS = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
VERTICES, INDICES = 34962, 34963  # buffer targets
FLOAT = _COMPONENTS["float32"]


class Glb:
    """A document that is being put together."""

    def __init__(self, provenance: Mapping[str, str] | None = None) -> None:
        """Begin with an asset that names its provenance."""
        extras = {"provenance": dict(provenance or {})}
        asset = {"version": "2.0", "generator": f"uika-drjit {__version__}", "extras": extras}
        self.document: dict[str, Any] = {"asset": asset, "accessors": [], "bufferViews": []}
        self._chunks: list[bytes] = []
        self._size = 0

    def add(self, array: NDArray[Any], target: int | None = None, *, bounds: bool = False, unit: bool = False) -> int:
        """Store rows and return their accessor.

        Args:
            array: [N], [N,C] or [N,16] (column-major matrices) of float32, uint8, uint16 or uint32.
            target: `VERTICES`, `INDICES`, or None for everything else.
            bounds: whether to state minimum and maximum, which positions and times must.
            unit: whether integers stand for numbers in [0,1].
        """
        width = 1 if array.ndim == 1 else array.shape[1]
        accessor: dict[str, Any] = {
            "bufferView": self.view(np.ascontiguousarray(array).tobytes(), target),
            "componentType": _COMPONENTS[array.dtype.name],
            "count": len(array),
            "type": next(kind for kind, size in WIDTHS.items() if size == width),
        }
        if unit:
            accessor["normalized"] = True
        if bounds:
            accessor["min"], accessor["max"] = (np.atleast_1d(edge(array, 0)).tolist() for edge in (np.min, np.max))
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def view(self, data: bytes, target: int | None = None) -> int:
        """Store bytes and return their buffer view."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        self.document["bufferViews"].append(view if target is None else {**view, "target": target})
        padded = data + bytes(-len(data) % 4)  # everything begins at a multiple of four bytes
        self._chunks.append(padded)
        self._size += len(padded)
        return len(self.document["bufferViews"]) - 1

    def write(self, path: str | Path, suffix: str = ".glb") -> None:
        """Write the file.

        Raises:
            UikaError: wrong extension, or nothing can be written there.
        """
        self.document["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(self.document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        with replacing(check_output(path, suffix)) as temporary, temporary.open("wb") as file:
            file.write(struct.pack("<III", _MAGIC, 2, 12 + 8 + len(text) + 8 + self._size))
            file.write(struct.pack("<II", len(text), _JSON) + text)
            file.write(struct.pack("<II", self._size, _BIN) + b"".join(self._chunks))


def read_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk of a file.

    Raises:
        UikaError: no such file, or it is damaged.
    """
    if not path.is_file():
        raise UikaError(f"{path}: no such file")
    data = path.read_bytes()
    try:
        magic, version, length = struct.unpack_from("<III", data)
        size, kind = struct.unpack_from("<II", data, 12)
        if magic != _MAGIC or version != 2 or kind != _JSON or length > len(data):
            raise ValueError("wrong header or cut short")
        document = json.loads(data[20 : 20 + size])
        if not isinstance(document, dict):
            raise ValueError("its JSON is no object")
    except (struct.error, ValueError, RecursionError) as error:
        raise UikaError(f"{path}: is damaged or no .glb file ({error})") from error
    return document, data[20 + size + 8 :]


def read_accessor(document: dict[str, Any], binary: bytes, index: int) -> NDArray[np.float32]:
    """Rows [N,C] of one float accessor.

    Raises:
        ValueError: it does not lie inside the data, is not stored as floats, or holds values that are not finite.
        KeyError, IndexError, TypeError: the document lacks what an accessor needs.
    """
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    if accessor["componentType"] != FLOAT:
        raise ValueError("an attribute is not stored as floats")
    width = WIDTHS[accessor["type"]]
    inside, stride = accessor.get("byteOffset", 0), view.get("byteStride", 4 * width)
    start, count = view.get("byteOffset", 0) + inside, accessor["count"]
    end = stride * (count - 1) + 4 * width
    if min(start, inside, count) < 0 or stride < 4 * width or inside + end > view["byteLength"]:
        raise ValueError("an attribute does not fit its buffer view")
    if start + end > len(binary):
        raise ValueError("an attribute reaches beyond the end of the data")
    rows = np.ndarray((count, width), "<f4", binary, start, (stride, 4))
    if not np.isfinite(rows).all():
        raise ValueError("an attribute holds values that are not finite")
    return rows.copy()
