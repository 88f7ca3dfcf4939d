"""Binary glTF with the Khronos extension KHR_gaussian_splatting; metres, Y up, sRGB colours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from drjit_splat.constants import SH_C0
from uika.errors import UikaError
from uika.export.splats import Splats
from uika.io.files import check_output
from uika.io.glb import VERTICES, Glb, read_accessor, read_parts

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0  # mode of a primitive
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
    check_output(path, ".glb")
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
        _NAMES["harmonics"]: ((splats.colors - 0.5) / SH_C0).numpy(),
        "COLOR_0": (points * 255).round().byte().numpy(),
    }
    file = Glb(provenance)
    attributes = {
        name: file.add(array, VERTICES, bounds=name == "POSITION", unit=name == "COLOR_0")
        for name, array in arrays.items()
    }
    primitive = {
        "mode": _POINTS,
        "attributes": attributes,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    file.document.update(
        extensionsUsed=[EXTENSION],
        scene=0,
        scenes=[{"nodes": [0]}],
        nodes=[{"mesh": 0, "name": "avatar"}],
        meshes=[{"primitives": [primitive]}],
    )
    file.write(path)


def read_glb(path: str | Path) -> Splats:
    """Read the first Gaussian primitive of a file; float attributes, harmonics above degree 0 are left out.

    Raises:
        UikaError: no such file, damaged, or without Gaussians that can be read; it names the file.
    """
    source = Path(path)
    document, binary = read_parts(source)
    try:
        found = (p for mesh in document["meshes"] for p in mesh["primitives"] if EXTENSION in p.get("extensions", {}))
        primitive = next(found, None)
        if primitive is None:
            raise UikaError(f"{source}: holds no Gaussians ({EXTENSION})")
        read = {
            key: torch.from_numpy(read_accessor(document, binary, primitive["attributes"][name]))
            for key, name in _NAMES.items()
        }
    except (KeyError, IndexError, TypeError, ValueError) as error:
        if isinstance(error, UikaError):
            raise
        raise UikaError(f"{source}: has Gaussians that cannot be read ({error})") from error
    colors = 0.5 + SH_C0 * read["harmonics"]
    return Splats(read["means"], read["quats"].roll(1, -1), read["scales"], read["opacities"][:, 0], colors)


def glb_provenance(path: str | Path) -> dict[str, str]:
    """What `asset.extras.provenance` says; empty if there is nothing.

    Raises:
        UikaError: no such file, or it is damaged.
    """
    asset = read_parts(Path(path))[0].get("asset")
    extras = asset.get("extras") if isinstance(asset, dict) else None
    found = extras.get("provenance") if isinstance(extras, dict) else None
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else {}
