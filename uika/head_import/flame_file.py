"""Read a FLAME model file (2020, 2023 or 2023 Open) as a head; the licensed file itself is the user's to bring."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.head.model import JOINT_PARENTS, HeadError, HeadModel
from uika.head_import.unpickle import UnpickleError, read_arrays
from uika.io.files import stands_for_another
from uika.io.npz import ArraysError, read_npy, read_npz

VERTICES = 5023
IDENTITIES, EXPRESSIONS = 300, 100
EYELIDS = ("eyelidLeft", "eyelidRight")
_TORCH = "{}: is a PyTorch file; give the .pkl that FLAME comes as, or an .npz"
_OLD_TORCH = bytes.fromhex("80028a0a6cfc9c46f9206aa850192e")  # how files begin that PyTorch before 1.6 wrote
_ROUNDING = 1e-3  # below 0 that weights may be
_HEIGHTS = (0.05, 2.0)  # metres of a mean head; files in millimetres or centimetres lie far outside
_SHAPES: dict[str, tuple[int, ...]] = {
    "v_template": (VERTICES, 3),
    "shapedirs": (VERTICES, 3, IDENTITIES + EXPRESSIONS),
    "posedirs": (VERTICES, 3, 9 * (len(JOINT_PARENTS) - 1)),
    "J_regressor": (len(JOINT_PARENTS), VERTICES),
    "weights": (VERTICES, len(JOINT_PARENTS)),
}


def read_flame(path: str | Path, obj: str | Path | None = None, eyelids: Sequence[str | Path] = ()) -> HeadModel:
    """Read a FLAME model without landmarks and masks, which `uika.head_import` adds.

    Args:
        path: the model file, the public pickle (read by `read_arrays`, nothing in it is executed) or an `.npz` with
            the same arrays: `v_template`, `shapedirs`, `posedirs`, `J_regressor`, `weights`, `kintree_table`, `f`.
        obj: a Wavefront file of the same vertices with texture coordinates; it may bring its own triangles (a closed
            mouth, say). None takes `vt` and `ft` from the model file.
        eyelids: two `.npy` files [5023,3] in metres that shut the left and the right lid.

    Raises:
        HeadError: a file is missing, damaged, lacks an array or has arrays of other sizes; it names the file.
    """
    source = Path(path)
    arrays = _read(source)
    try:
        _check(arrays)
        faces, uvs, uv_faces = _read_obj(Path(obj)) if obj is not None else _own_uvs(arrays)
        lids = [_read_offset(Path(lid)) for lid in eyelids]
        if len(lids) not in (0, 2):
            raise HeadError(f"eyelids: give two files, left and right, not {len(lids)}")
        return _assembled(arrays, faces, uvs, uv_faces, lids)
    except HeadError as error:
        raise HeadError(f"{source}: {error}") from error


def _assembled(
    arrays: Mapping[str, np.ndarray], faces: Tensor, uvs: Tensor, uv_faces: Tensor, lids: list[Tensor]
) -> HeadModel:
    template = _real(arrays["v_template"])
    shapes = _real(arrays["shapedirs"]).permute(2, 0, 1).contiguous()
    expression = torch.cat((shapes[IDENTITIES:], *(lid[None] for lid in lids)))
    regressor = _real(arrays["J_regressor"])
    names = tuple(f"expression{index:03d}" for index in range(EXPRESSIONS)) + (EYELIDS if lids else ())
    weights = _real(arrays["weights"])
    head = HeadModel(
        id="flame",
        template=template,
        identity_basis=shapes[:IDENTITIES],
        expression_basis=expression,
        expression_names=names,
        faces=faces,
        uvs=uvs,
        uv_faces=uv_faces,
        joints=regressor @ template,
        joint_identity=torch.einsum("jv,kvc->kjc", regressor, shapes[:IDENTITIES]),
        joint_expression=torch.einsum("jv,kvc->kjc", regressor, expression),
        lbs_weights=weights / weights.sum(-1, keepdim=True),
        pose_basis=_real(arrays["posedirs"]).permute(2, 0, 1).contiguous(),
        masks={},
        landmark_faces=torch.zeros(0, dtype=torch.int64),
        landmark_barycentrics=torch.zeros(0, 3),
        landmark_ids=torch.zeros(0, dtype=torch.int64),
        landmark_weights=torch.zeros(0),
    )
    return _named(head)


def _named(head: HeadModel) -> HeadModel:
    """The head with an id made from its content, so that avatars of another FLAME version are told apart."""
    digest = hashlib.sha256()
    for tensor in (head.template, head.identity_basis, head.expression_basis, head.faces, head.uvs, head.uv_faces):
        digest.update(tensor.numpy().tobytes())
    return replace(head, id=f"flame-{digest.hexdigest()[:12]}")


def _read(source: Path) -> Mapping[str, np.ndarray]:
    if not source.is_file():
        raise HeadError(f"{source}: no such model file; FLAME models come from https://flame.is.tue.mpg.de")
    if zipfile.is_zipfile(source):
        try:
            return read_npz(source)
        except ArraysError as error:
            if _is_torch(source):
                raise HeadError(_TORCH.format(source)) from error
            if packed := next((name for name in _names(source) if name.lower().endswith(".pkl")), None):
                raise HeadError(f"{source}: is an archive; unpack it and give '{packed}' of it") from error
            raise HeadError(f"{source}: cannot be read as an .npz of plain arrays: {error}") from error
    if source.suffix == ".npz":
        raise HeadError(f"{source}: is damaged or no .npz file; fetch it again")
    if stand_in := stands_for_another(source):
        raise HeadError(f"{source}: is {stand_in}, not the model file; download the file itself")
    try:
        return read_arrays(source)
    except UnpickleError as error:
        with source.open("rb") as file:
            if file.read(len(_OLD_TORCH)) == _OLD_TORCH:
                raise HeadError(_TORCH.format(source)) from error
        raise HeadError(str(error)) from error


def _is_torch(source: Path) -> bool:
    return any(name.endswith(("/data.pkl", "/constants.pkl")) for name in _names(source))


def _names(source: Path) -> list[str]:
    """What lies in an archive; nothing where that cannot be read."""
    try:
        with zipfile.ZipFile(source) as archive:
            return archive.namelist()
    except Exception:  # a damaged directory can fail in any way
        return []


def _check(arrays: Mapping[str, np.ndarray]) -> None:
    for name, shape in _SHAPES.items():
        if name not in arrays:
            raise HeadError(f"lacks the array '{name}'; is it a FLAME model file?")
        found = arrays[name].shape
        if found != shape:
            raise HeadError(f"array '{name}' has shape {found} where FLAME has {shape}")
        if not np.issubdtype(arrays[name].dtype, np.number) or not np.isfinite(arrays[name]).all():
            raise HeadError(f"array '{name}' does not hold finite numbers")
    if arrays["weights"].min() < -_ROUNDING or arrays["weights"].sum(-1).min() <= 0:
        raise HeadError("array 'weights' has a vertex that no joint moves, or one less than nothing")
    height = float(np.ptp(arrays["v_template"], axis=0).max())
    if not _HEIGHTS[0] <= height <= _HEIGHTS[1]:
        raise HeadError(f"has a mean head of {height:.3g} metres; FLAME's unit is the metre, scale v_template to it")
    if "kintree_table" in arrays:
        table = arrays["kintree_table"]
        if table.ndim != 2 or table.shape[1] != len(JOINT_PARENTS):
            raise HeadError(f"array 'kintree_table' has shape {table.shape} where FLAME has (2, {len(JOINT_PARENTS)})")
        if not _whole(table):
            raise HeadError("array 'kintree_table' does not hold whole numbers")
        parents = table[0].astype(np.uint32).astype(np.int32)
        if tuple(parents[1:].tolist()) != JOINT_PARENTS[1:]:
            raise HeadError(f"array 'kintree_table' has the parents {parents.tolist()}, FLAME has {JOINT_PARENTS}")


def _whole(array: np.ndarray) -> bool:
    return array.dtype.kind in "iu" or (array.dtype.kind == "f" and bool((array == np.floor(array)).all()))


def _own_uvs(arrays: Mapping[str, np.ndarray]) -> tuple[Tensor, Tensor, Tensor]:
    if "vt" not in arrays or "ft" not in arrays or "f" not in arrays:
        raise HeadError("has no texture coordinates; give a Wavefront file of the mesh that has them with --obj")
    vt = arrays["vt"]
    if vt.ndim != 2 or vt.shape[1] < 2 or vt.dtype.kind not in "fiu":
        raise HeadError(f"array 'vt' has shape {vt.shape} where texture coordinates [T,2] are needed")
    for name in ("f", "ft"):
        if arrays[name].ndim != 2 or arrays[name].shape[1] != 3 or not _whole(arrays[name]):
            raise HeadError(f"array '{name}' is no table of triangles [F,3] by whole numbers")
    return (
        torch.from_numpy(arrays["f"].astype(np.int64)),
        _real(vt)[:, :2].contiguous(),
        torch.from_numpy(arrays["ft"].astype(np.int64)),
    )


def _read_obj(path: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles [F,3], texture coordinates [T,2] (v up) and texture triangles [F,3]; polygons become fans."""
    if not path.is_file():
        raise HeadError(f"{path}: no such .obj file")
    vertices = 0
    uvs: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    uv_faces: list[tuple[int, int, int]] = []
    try:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            key, *words = line.split() or [""]
            if key == "v":
                vertices += 1
            elif key == "vt":
                uvs.append([float(words[0]), float(words[1])])
            elif key == "f":
                corners = [word.split("/") for word in words]
                points = [_index(corner[0], vertices) for corner in corners]
                places = [_index(corner[1], len(uvs)) for corner in corners]
                for k in range(1, len(corners) - 1):
                    faces.append((points[0], points[k], points[k + 1]))
                    uv_faces.append((places[0], places[k], places[k + 1]))
    except (ValueError, IndexError) as error:
        raise HeadError(f"{path}: a line is damaged or its faces have no texture coordinates ({error})") from error
    if vertices != VERTICES or not faces or not uvs:
        raise HeadError(
            f"{path}: has {vertices} vertices, {len(uvs)} texture coordinates and {len(faces)} triangles; "
            f"a FLAME mesh has {VERTICES} vertices and needs the other two"
        )
    try:
        return _topology(torch.tensor(faces), torch.tensor(uvs), torch.tensor(uv_faces))
    except HeadError as error:
        raise HeadError(f"{path}: {error}") from error


def _topology(faces: Tensor, uvs: Tensor, uv_faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same, if every triangle's corners exist."""
    for name, index, count in (("vertex", faces, VERTICES), ("texture coordinate", uv_faces, len(uvs))):
        wrong = index[(index < 0) | (index >= count)]
        if len(wrong):
            raise HeadError(f"a triangle names {name} number {int(wrong[0]) + 1}; there are {count:,}")
    if faces.shape != uv_faces.shape or faces.ndim != 2 or faces.shape[1] != 3:
        raise HeadError(f"has triangles of shape {list(faces.shape)} and texture triangles {list(uv_faces.shape)}")
    return faces, uvs, uv_faces


def _index(word: str, count: int) -> int:
    number = int(word)
    if not abs(number) < 1 << 31:
        raise ValueError(f"number {word[:40]}")
    return number - 1 if number > 0 else count + number


def _read_offset(path: Path) -> Tensor:
    try:
        offset = read_npy(path)
    except ArraysError as error:
        raise HeadError(f"{path}: cannot be read as an .npy of numbers ({error})") from error
    if offset.reshape(-1, 3).shape != (VERTICES, 3):
        raise HeadError(f"{path}: has shape {offset.shape}; eyelids need ({VERTICES}, 3)")
    return _real(offset.reshape(-1, 3))


def _real(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
