"""One web page that holds an avatar, a motion and a viewer for them, and needs no network."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.framing import FOV, Framing, target_and_distance
from uika.errors import UikaError
from uika.export.driven import driven_arrays, driven_names
from uika.export.vertex_motion import vertex_motion
from uika.head import HeadModel, HeadParameters, rest_joints
from uika.io.files import check_output, replacing
from uika.motion import Motion

_MAX_MODES = 48
_POSITION_ERROR, _TURN_ERROR = 5e-5, 2e-3  # metres and radians/2 that the motion's compression may cost
_METRES = 0.02  # of movement that count as much as one radian when modes are chosen
_STEPS = 32767
_ALIGNMENT = 8  # bytes
_SCRIPTS = ("drive.js", "shaders.js", "viewer.js")
_SCENE_TAG = '<script id="scene" type="application/json">'


def write_html(path: str | Path, avatar: Avatar, motion: Motion, head: HeadModel, frame: Framing = "bust") -> int:
    """Write a page that plays a motion, orbits with the mouse and opens from disk without a network.

    Scripts drive its face by `avatar.set`, `avatar.pose` and messages; see docs/page.md.

    Args:
        path: `.html` file.
        avatar: the avatar; it takes about 20 bytes for each Gaussian.
        motion: the movement; a camera path in it is left out.
        head: the head model that the avatar was made for.
        frame: what the page shows at first, as in `uika.neutral_camera`.

    Returns:
        The file's size in bytes.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    target = check_output(path, ".html")
    avatar.check_head(head)
    arrays = {**_still(avatar, head), **_moving(avatar, motion, head), **driven_arrays(avatar, head)}
    still = HeadParameters.zeros(head).replace(identity=avatar.identity)
    manifest, binary = _packed(arrays)
    middle, distance = target_and_distance(avatar, frame)
    scene = {
        "arrays": manifest,
        "count": len(avatar),
        "vertices": len(head.template),
        "frames": len(motion),
        "fps": motion.fps,
        "target": middle.tolist(),
        "distance": distance,
        "fov": FOV,
        "actions": driven_names(head),
        "neck": rest_joints(head, still)[1].tolist(),
        "provenance": dict(avatar.provenance),
    }
    folder = resources.files("uika.export")
    page = _fill(
        (folder / "viewer.html").read_text(encoding="utf-8"),
        {
            "SCENE": _script_safe(scene),
            "SCRIPT": "\n".join((folder / name).read_text(encoding="utf-8") for name in _SCRIPTS),
            "DATA": base64.b64encode(gzip.compress(binary, 6, mtime=0)).decode("ascii"),
        },
    )
    with replacing(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target.stat().st_size


def html_provenance(path: str | Path) -> dict[str, str]:
    """The provenance that a page of `write_html` shows; empty if it is another page.

    Raises:
        UikaError: no such file.
    """
    source = Path(path)
    if not source.is_file():
        raise UikaError(f"{source}: no such .html file")
    text = source.read_text(encoding="utf-8", errors="replace")
    start = text.find(_SCENE_TAG)
    if start < 0:
        return {}
    try:
        scene, _ = json.JSONDecoder().raw_decode(text, start + len(_SCENE_TAG))
        return {str(key): str(value) for key, value in scene["provenance"].items()}
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
        return {}


def _still(avatar: Avatar, head: HeadModel) -> dict[str, NDArray[Any]]:
    """What does not move: binding, offset from the surface, rotation, size and colour of each Gaussian."""
    corners = head.faces[avatar.triangle]
    vertices = avatar.canonical_vertices(head)
    surface = (vertices[corners] * avatar.barycentric[..., None]).sum(1)
    offset, offset_step = _rounded(avatar.means - surface)
    colors = torch.cat((avatar.colors, avatar.opacities[:, None]), -1).clamp(0, 1)
    quats = torch.nn.functional.normalize(avatar.quats, dim=-1)
    logs = avatar.scales.clamp_min(1e-7).log()
    low, high = float(logs.min()), float(logs.max())
    span = max(high - low, 1e-6)
    return {
        "corners": corners.numpy().astype(np.uint32 if len(head.template) > 65536 else np.uint16),
        "barycentric": (avatar.barycentric[:, :2].clamp(0, 1) * 65535).round().int().numpy().astype(np.uint16),
        "offset": offset,
        "offsetStep": np.array([offset_step], np.float32),
        "quats": (quats * _STEPS).round().short().numpy(),
        "scales": ((logs - low) / span * 65535).round().int().numpy().astype(np.uint16),
        "scaleRange": np.array([low, span / 65535], np.float32),
        "colors": (colors * 255).round().byte().numpy(),
    }


def _moving(avatar: Avatar, motion: Motion, head: HeadModel) -> dict[str, NDArray[Any]]:
    """Position, rotation and growth of each vertex in each frame as a mean plus a few modes.

    A frame is `mean + sum_k weights[t,k] * step[k] * modes[k]`, eight numbers a vertex: x y z, growth, w x y z.
    """
    rows = vertex_motion(avatar, motion, head)
    unit = torch.tensor([1 / _METRES] * 3 + [1.0] * 5)
    mean = rows.mean(0)
    scaled = ((rows - mean) * unit).flatten(1)
    # Frames are far fewer than numbers a frame: the eigenvectors of their small Gram matrix give the modes.
    values, vectors = torch.linalg.eigh((scaled @ scaled.T).double())
    order = values.argsort(descending=True)[:_MAX_MODES]
    basis = (vectors[:, order].T.float() @ scaled).unflatten(1, rows.shape[1:])
    weights = vectors[:, order].float()
    limit = torch.tensor([_POSITION_ERROR] * 3 + [_TURN_ERROR] * 5)
    count, rest = 0, rows - mean
    while count < len(order) and bool((rest.abs() > limit).any()):
        rest = rest - weights[:, count, None, None] * (basis[count] / unit)
        count += 1
    modes = basis[:count] / unit
    # Positions and turns differ in size, so each of the eight numbers has its own step in each mode.
    steps = (modes.abs().amax(1) / _STEPS).clamp_min(1e-12)
    return {
        "mean": mean.numpy(),
        "modes": (modes / steps[:, None]).round().short().numpy(),
        "steps": steps.numpy(),
        "weights": weights[:, :count].contiguous().numpy(),
    }


def _rounded(values: Tensor) -> tuple[NDArray[np.int16], float]:
    """Values as 16-bit whole numbers and the step between them."""
    step = max(float(values.abs().max()) / _STEPS, 1e-12)
    return (values / step).round().short().numpy(), step


def _packed(arrays: Mapping[str, NDArray[Any]]) -> tuple[list[dict[str, Any]], bytes]:
    manifest, parts, offset = [], [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        manifest.append({"name": name, "type": array.dtype.name, "length": array.size, "offset": offset})
        data += b"\0" * (-len(data) % _ALIGNMENT)
        parts.append(data)
        offset += len(data)
    return manifest, b"".join(parts)


def _script_safe(value: object) -> str:
    """JSON that cannot end the script element that it stands in."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _fill(template: str, parts: Mapping[str, str]) -> str:
    """The template with each `@@NAME@@` replaced, in one pass over the template only."""
    pieces = template.split("@@")
    return "".join(parts[piece] if index % 2 else piece for index, piece in enumerate(pieces))
