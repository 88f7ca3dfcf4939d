"""The file that a parametric head is kept in, and the built-in head."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.assets import BUST, HEAD
from uika.head.bust import TORSO, Bust, unpack_bust
from uika.head.model import HeadError, HeadModel, check_shape
from uika.io.npz import ArraysError, read_npz

BUILTIN_ID = "builtin-2"  # of the built-in head with its bust; without it, it is "builtin-1"
_INT16_MAX = 32767
_QUANTISED = ("identity_basis", "expression_basis")


def load_head(path: str | Path | None = None) -> HeadModel:
    """Read a head file.

    Args:
        path: a head `.npz`; None reads the file named by the environment variable `UIKA_HEAD`, else the built-in head
            with its bust.

    Returns:
        The model in float32; the same file is read once per process.

    Raises:
        HeadError: the file is missing, damaged, or its arrays do not fit together.
    """
    chosen = path if path is not None else os.environ.get("UIKA_HEAD")
    if not chosen:
        return _builtin()
    resolved = Path(chosen)
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
    if head.bust is not None:
        arrays["bust_head_id"] = np.array(head.bust.head_id)
        arrays["bust_start"] = np.array([head.bust.vertex, head.bust.face, head.bust.uv], dtype=np.int32)
        arrays["bust_modes_q"], arrays["bust_modes_scale"] = _quantise(head.bust.modes)
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


def builtin_head() -> HeadModel:
    """The built-in head with its bust, whatever `UIKA_HEAD` names."""
    return _builtin()


@lru_cache(maxsize=1)
def _builtin() -> HeadModel:
    head = _parsed(HEAD, _from_arrays)
    return _parsed(BUST, lambda arrays: _joined(head, arrays, BUILTIN_ID))


@lru_cache(maxsize=4)
def _load(path: Path, modified: int, size: int) -> HeadModel:
    return _parsed(path, _from_arrays)


def _parsed(path: Path, parse: Callable[[Mapping[str, np.ndarray]], HeadModel]) -> HeadModel:
    try:
        arrays = read_npz(path)
    except ArraysError as error:
        raise HeadError(f"head file {path} cannot be read as an .npz of plain arrays: {error}") from error
    try:
        if "sha256" in arrays and content_hash(arrays) != str(arrays["sha256"]):
            raise HeadError("its content does not match its sha256 entry; fetch or convert it again")
        return parse(arrays)
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
        check_shape(f"{name}_scale", scale, (len(steps),))
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
        bust=_bust(arrays, basis) if "bust_start" in arrays else None,
        landmark_barycentrics=real("landmark_barycentrics"),
        landmark_weights=real("landmark_weights"),
        **{name: real(name) for name in reals},
        **{name: whole(name) for name in ("faces", "uv_faces", "landmark_faces", "landmark_ids")},
    )


def _bust(arrays: Mapping[str, np.ndarray], basis: Callable[[str], Tensor]) -> Bust:
    vertex, face, uv = (int(value) for value in arrays["bust_start"])
    return Bust(str(arrays["bust_head_id"]), vertex, face, uv, basis("bust_modes"))


def _quantise(basis: Tensor) -> tuple[np.ndarray, np.ndarray]:
    scale = basis.abs().amax((1, 2)).double() / _INT16_MAX if len(basis) else basis.new_zeros(0).double()
    steps = torch.where(scale[:, None, None] > 0, basis / scale.clamp_min(1e-30)[:, None, None], 0.0)
    return steps.round().to(torch.int16).numpy(), scale.float().numpy()


def _joined(head: HeadModel, arrays: Mapping[str, np.ndarray], name: str) -> HeadModel:
    """A head without bust and the bust of a file's arrays as one head with the id `name`.

    Raises:
        KeyError: an array is missing.
        ValueError: the bust was made for another head, or the arrays do not fit together.
    """
    bust = unpack_bust(arrays)
    if bust.head_id != head.id:
        raise ValueError(f"this bust was made for the head model '{bust.head_id}', not for '{head.id}'")
    count = len(bust.template)

    def still(values: Tensor) -> Tensor:
        return torch.cat((values, values.new_zeros(len(values), count, 3)), 1)

    masks = {name: torch.cat((mask, mask.new_zeros(count))) for name, mask in head.masks.items()}
    masks[TORSO] = torch.cat((torch.zeros(len(head.template)), torch.ones(count)))
    return replace(
        head,
        id=name,
        template=torch.cat((head.template, bust.template)),
        identity_basis=torch.cat((head.identity_basis, bust.identity), 1),
        expression_basis=still(head.expression_basis),
        faces=torch.cat((head.faces, bust.faces)),
        uvs=torch.cat((head.uvs, bust.uvs)),
        uv_faces=torch.cat((head.uv_faces, bust.uv_faces + len(head.uvs))),
        lbs_weights=torch.cat((head.lbs_weights, bust.lbs_weights)),
        pose_basis=None if head.pose_basis is None else still(head.pose_basis),
        masks=masks,
        bust=Bust(head.id, len(head.template), len(head.faces), len(head.uvs), bust.modes),
    )
