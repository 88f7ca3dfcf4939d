"""The parametric head: its data, and the file it is kept in."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.assets import HEAD
from uika.io.npz import ArraysError, read_npz

JOINT_NAMES = ("root", "neck", "jaw", "left_eye", "right_eye")
JOINT_PARENTS = (-1, 0, 1, 1, 1)
_INT16_MAX = 32767
_QUANTISED = ("identity_basis", "expression_basis")


class HeadError(ValueError):
    """A head file or a head's arrays cannot be used; the message names the file and the array."""


@dataclass(frozen=True, eq=False)
class HeadModel:
    """A head with linear identity and expression bases and linear-blend skinning.

    Head space is in metres with Y up; the face looks along +Z and +X is the subject's left.
    Sizes: V vertices, F triangles, T texture vertices, K identity modes, E expressions, L landmarks.
    Floating tensors are float32 and integer tensors int64 unless `to` changed them.
    """

    id: str
    template: Tensor  # [V,3] metres
    identity_basis: Tensor  # [K,V,3] metres per standard deviation
    expression_basis: Tensor  # [E,V,3] metres at full activation
    expression_names: tuple[str, ...]  # E names
    faces: Tensor  # [F,3] vertex ids, counter-clockwise seen from outside
    uvs: Tensor  # [T,2] in [0,1], v up as in OBJ files
    uv_faces: Tensor  # [F,3] ids into uvs
    joints: Tensor  # [5,3] rest joints in the order of JOINT_NAMES
    joint_identity: Tensor  # [K,5,3]
    joint_expression: Tensor  # [E,5,3]
    lbs_weights: Tensor  # [V,5], rows sum to one
    pose_basis: Tensor | None  # [36,V,3] pose correctives, or None
    masks: Mapping[str, Tensor]  # name -> [V] weight in [0,1]
    landmark_faces: Tensor  # [L] triangle of each embedded landmark
    landmark_barycentrics: Tensor  # [L,3]
    landmark_ids: Tensor  # [L] index in the 478-point face mesh
    landmark_weights: Tensor  # [L] trust in (0,1]

    def __post_init__(self) -> None:
        """Check that the arrays fit together.

        Raises:
            HeadError: a shape or an index does not fit.
        """
        V, F, L = len(self.template), len(self.faces), len(self.landmark_faces)
        K, E = len(self.identity_basis), len(self.expression_names)
        expected = {
            "template": (V, 3),
            "identity_basis": (K, V, 3),
            "expression_basis": (E, V, 3),
            "faces": (F, 3),
            "uvs": (len(self.uvs), 2),
            "uv_faces": (F, 3),
            "joints": (5, 3),
            "joint_identity": (K, 5, 3),
            "joint_expression": (E, 5, 3),
            "lbs_weights": (V, 5),
            "landmark_faces": (L,),
            "landmark_barycentrics": (L, 3),
            "landmark_ids": (L,),
            "landmark_weights": (L,),
        }
        if self.pose_basis is not None:
            expected["pose_basis"] = (36, V, 3)
        for name, shape in expected.items():
            _check_shape(name, getattr(self, name), shape)
        for name, mask in self.masks.items():
            _check_shape(f"mask_{name}", mask, (V,))
        _check_indices("faces", self.faces, V)
        _check_indices("uv_faces", self.uv_faces, len(self.uvs))
        _check_indices("landmark_faces", self.landmark_faces, F)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> HeadModel:
        """Return a copy whose floating tensors have `dtype` and whose tensors all lie on `device`."""

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=dtype if tensor.is_floating_point() else None)

        changed = {f.name: move(v) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        masks = {name: move(mask) for name, mask in self.masks.items()}
        return replace(self, masks=masks, **changed)  # type: ignore[arg-type]

    def landmarks(self, vertices: Tensor) -> Tensor:
        """Embedded landmarks [...,L,3] (or [...,L,2]) of a mesh [...,V,3] with this head's topology."""
        corners = vertices[..., self.faces[self.landmark_faces], :]
        return (corners * self.landmark_barycentrics[:, :, None].to(vertices.dtype)).sum(-2)


def load_head(path: str | Path | None = None) -> HeadModel:
    """Read a head file.

    Args:
        path: a head `.npz`; None reads the file named by the environment variable `UIKA_HEAD`, else the built-in head.

    Returns:
        The model in float32; the same file is read once per process.

    Raises:
        HeadError: the file is missing, damaged, or its arrays do not fit together.
    """
    resolved = Path(path if path is not None else os.environ.get("UIKA_HEAD") or HEAD)
    if not resolved.is_file():
        raise HeadError(f"head file {resolved} does not exist; pass a head .npz or unset UIKA_HEAD")
    stat = resolved.stat()
    return _load(resolved, stat.st_mtime_ns, stat.st_size)


def save_head(head: HeadModel, path: str | Path) -> None:
    """Write a head file that `load_head` reads back: bases as int16 per mode, weights as float16, masks as uint8."""
    arrays: dict[str, np.ndarray] = {
        "id": np.array(head.id),
        "expression_names": np.array(head.expression_names, dtype=np.str_),
    }
    for field in fields(head):
        value = getattr(head, field.name)
        if not isinstance(value, Tensor):
            continue
        if field.name in _QUANTISED:
            arrays[f"{field.name}_q"], arrays[f"{field.name}_scale"] = _quantise(value)
        elif field.name == "lbs_weights":
            arrays[field.name] = value.to(torch.float16).numpy()
        else:
            arrays[field.name] = value.to(torch.float32 if value.is_floating_point() else torch.int32).numpy()
    for name, mask in head.masks.items():
        arrays[f"mask_{name}"] = (mask.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    save_arrays(arrays, path)


def save_arrays(arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Write arrays, already in the head file's layout, with the `sha256` entry that `load_head` checks."""
    target = Path(path)
    sealed = {**arrays, "sha256": np.array(content_hash(arrays))}
    with tempfile.NamedTemporaryFile(dir=target.parent, suffix=".tmp", delete=False) as file:
        np.savez_compressed(file, **sealed)  # type: ignore[arg-type]
    Path(file.name).replace(target)


def content_hash(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes of the arrays, without the `sha256` entry itself."""
    digest = hashlib.sha256()
    for name in sorted(set(arrays) - {"sha256"}):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


@lru_cache(maxsize=4)
def _load(path: Path, modified: int, size: int) -> HeadModel:
    try:
        arrays = read_npz(path)
    except ArraysError as error:
        raise HeadError(f"head file {path} cannot be read as an .npz of plain arrays: {error}") from error
    try:
        if "sha256" in arrays and content_hash(arrays) != str(arrays["sha256"]):
            raise HeadError("its content does not match its sha256 entry; fetch or convert it again")
        return _from_arrays(arrays)
    except KeyError as error:
        raise HeadError(f"head file {path} lacks the array {error}") from error
    except (HeadError, TypeError, ValueError) as error:
        raise HeadError(f"head file {path}: {error}") from error


def _from_arrays(arrays: Mapping[str, np.ndarray]) -> HeadModel:
    def real(name: str) -> Tensor:
        return torch.from_numpy(arrays[name].astype(np.float32))

    def whole(name: str) -> Tensor:
        if not np.issubdtype(arrays[name].dtype, np.integer):
            raise HeadError(f"array '{name}' must hold integers, not {arrays[name].dtype}")
        return torch.from_numpy(arrays[name].astype(np.int64))

    def basis(name: str) -> Tensor:
        steps, scale = real(f"{name}_q"), real(f"{name}_scale")
        _check_shape(f"{name}_scale", scale, (len(steps),))
        return steps * scale[:, None, None]

    weights = real("lbs_weights")
    reals = ("template", "uvs", "joints", "joint_identity", "joint_expression")
    return HeadModel(
        id=str(arrays["id"]),
        identity_basis=basis("identity_basis"),
        expression_basis=basis("expression_basis"),
        expression_names=tuple(str(name) for name in arrays["expression_names"]),
        lbs_weights=weights / weights.sum(-1, keepdim=True),
        pose_basis=real("pose_basis") if "pose_basis" in arrays else None,
        masks={key[5:]: real(key) / 255 for key in sorted(arrays) if key.startswith("mask_")},
        landmark_barycentrics=real("landmark_barycentrics"),
        landmark_weights=real("landmark_weights"),
        **{name: real(name) for name in reals},
        **{name: whole(name) for name in ("faces", "uv_faces", "landmark_faces", "landmark_ids")},
    )


def _quantise(basis: Tensor) -> tuple[np.ndarray, np.ndarray]:
    scale = basis.abs().amax((1, 2)).double() / _INT16_MAX if len(basis) else basis.new_zeros(0).double()
    steps = torch.where(scale[:, None, None] > 0, basis / scale.clamp_min(1e-30)[:, None, None], 0.0)
    return steps.round().to(torch.int16).numpy(), scale.float().numpy()


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise HeadError(f"array '{name}' has shape {tuple(tensor.shape)} where {shape} is needed")
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        raise HeadError(f"array '{name}' holds values that are not finite")


def _check_indices(name: str, indices: Tensor, count: int) -> None:
    if indices.numel() and (int(indices.min()) < 0 or int(indices.max()) >= count):
        raise HeadError(f"array '{name}' points outside 0..{count - 1}")
