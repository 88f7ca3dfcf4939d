"""Binary glTF with the Khronos extension KHR_gaussian_splatting; metres, Y up, sRGB colours."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from uika._version import __version__
from uika.errors import UikaError
from uika.export.splats import Splats
from uika.io.files import check_output, replacing

EXTENSION = "KHR_gaussian_splatting"
_C0 = 0.28209479177387814  # the constant spherical harmonic
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _UBYTE, _POINTS, _ARRAY_BUFFER = 5126, 5121, 0, 34962
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_NAMES = {
    "means": "POSITION",
    "quats": f"{EXTENSION}:ROTATION",
    "scales": f"{EXTENSION}:SCALE",
    "opacities": f"{EXTENSION}:OPACITY",
    "harmonics": f"{EXTENSION}:SH_DEGREE_0_COEF_0",
}


def write_glb(path: str | Path, splats: Splats, provenance: Mapping[str, str] | None = None) -> None:
    """Write Gaussians as points that readers without the extension still show as coloured points.

    Args:
        path: `.glb` file.
        splats: Gaussians with Y up.
        provenance: kept in `asset.extras`.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    target = check_output(path, ".glb")
    wxyz = torch.nn.functional.normalize(splats.quats, dim=-1)
    linear = torch.where(
        splats.colors <= 0.04045, splats.colors / 12.92, ((splats.colors + 0.055) / 1.055).clamp_min(0) ** 2.4
    )
    points = torch.cat((linear, splats.opacities[:, None]), -1).clamp(0, 1)
    arrays: dict[str, NDArray[Any]] = {
        _NAMES["means"]: splats.means.numpy(),
        _NAMES["quats"]: wxyz.roll(-1, -1).numpy(),
        _NAMES["scales"]: splats.scales.numpy(),
        _NAMES["opacities"]: splats.opacities.numpy(),
        _NAMES["harmonics"]: ((splats.colors - 0.5) / _C0).numpy(),
        "COLOR_0": (points * 255).round().byte().numpy(),
    }
    chunks, views, accessors, offset = [], [], [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()  # every row is a multiple of four bytes, so all stay aligned
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data), "target": _ARRAY_BUFFER})
        width = 1 if array.ndim == 1 else array.shape[1]
        accessor: dict[str, Any] = {
            "bufferView": len(views) - 1,
            "componentType": _UBYTE if array.dtype == np.uint8 else _FLOAT,
            "count": len(array),
            "type": next(kind for kind, size in _WIDTHS.items() if size == width),
        }
        if array.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor["min"], accessor["max"] = array.min(0).tolist(), array.max(0).tolist()
        accessors.append(accessor)
        chunks.append(data)
        offset += len(data)
    primitive = {
        "mode": _POINTS,
        "attributes": {name: index for index, name in enumerate(arrays)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {
            "version": "2.0",
            "generator": f"uika-drjit {__version__}",
            "extras": {"provenance": dict(provenance or {})},
        },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "avatar"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<III", _MAGIC, 2, 12 + 8 + len(text) + 8 + offset))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", offset, _BIN) + b"".join(chunks))


def read_glb(path: str | Path) -> Splats:
    """Read the first Gaussian primitive of a file; float attributes, harmonics above degree 0 are left out.

    Raises:
        UikaError: no such file, damaged, or without Gaussians that can be read; it names the file.
    """
    source = Path(path)
    document, binary = _parts(source)
    try:
        found = (p for mesh in document["meshes"] for p in mesh["primitives"] if EXTENSION in p.get("extensions", {}))
        primitive = next(found, None)
        if primitive is None:
            raise UikaError(f"{source}: holds no Gaussians ({EXTENSION})")
        read = {
            key: torch.from_numpy(_accessor(document, binary, primitive["attributes"][name]))
            for key, name in _NAMES.items()
        }
    except (KeyError, IndexError, TypeError, ValueError) as error:
        if isinstance(error, UikaError):
            raise
        raise UikaError(f"{source}: has Gaussians that cannot be read ({error})") from error
    colors = 0.5 + _C0 * read["harmonics"]
    return Splats(read["means"], read["quats"].roll(1, -1), read["scales"], read["opacities"][:, 0], colors)


def glb_provenance(path: str | Path) -> dict[str, str]:
    """What `asset.extras.provenance` says; empty if there is nothing.

    Raises:
        UikaError: no such file, or it is damaged.
    """
    asset = _parts(Path(path))[0].get("asset")
    extras = asset.get("extras") if isinstance(asset, dict) else None
    found = extras.get("provenance") if isinstance(extras, dict) else None
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else {}


def _parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk."""
    if not path.is_file():
        raise UikaError(f"{path}: no such .glb file")
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


def _accessor(document: dict[str, Any], binary: bytes, index: int) -> NDArray[np.float32]:
    """Rows [N,C] of one float accessor."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    if accessor["componentType"] != _FLOAT:
        raise ValueError("an attribute is not stored as floats")
    width = _WIDTHS[accessor["type"]]
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
