"""From the files of one frame to a `Sample`, for folders and shards alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.data.encode import decode_colour, decode_depth, decode_mask, decode_uv
from uika.data.sample import DataError, Sample
from uika.errors import UikaError
from uika.head import Camera, HeadParameters
from uika.io.npz import ArraysError, read_npz

FLAME_VERTICES, TRACKED_VERTICES = 5023, 5143  # VHAP's FLAME has rows of teeth behind the vertices of the model
# What all frames of a capture may share. The file that says so also holds a pose, which is that of no frame.
SHARED = ("shape", "static_offset")
_POSE = {"rotation": ("rotation", 3), "neck": ("neck_pose", 3), "jaw": ("jaw_pose", 3), "eyes": ("eyes_pose", 6)}


@dataclass(frozen=True)
class Frame:
    """What a description says about one image."""

    timestep: int
    camera_id: str
    lens: tuple[float, ...]  # fl_x, fl_y, cx, cy in pixels
    matrix: tuple[tuple[float, ...], ...]  # 4x4 camera to world, OpenGL axes, metres
    files: Mapping[str, str]  # description key -> path


def build_sample(
    frame: Frame, contents: Mapping[str, bytes], canonical: Mapping[str, np.ndarray], where: str, identity: str
) -> Sample:
    """Decode the files of a frame.

    Args:
        frame: the frame.
        contents: description key (`file_path`, ...) -> bytes of the file.
        canonical: arrays that all frames share; of these, `SHARED` are read.
        where: the folder or shard, for messages.
        identity: name of the person's capture.

    Raises:
        DataError: a file cannot be decoded or does not fit the others; the message names it.
    """
    names = {kind: f"{where}/{path}" for kind, path in frame.files.items()}
    try:
        image = decode_colour(contents["file_path"], names["file_path"])
        size = image.shape[:2]
        mask = np.full(size, 255, np.uint8)
        if "fg_mask_path" in contents:
            mask = decode_mask(contents["fg_mask_path"], names["fg_mask_path"])
            _same_size(mask, size, names["fg_mask_path"])
        labels: dict[str, Tensor] = {}
        if "uv_path" in contents:
            uv, valid = decode_uv(contents["uv_path"], names["uv_path"])
            _same_size(valid, size, names["uv_path"])
            labels |= {"uv": torch.from_numpy(uv), "uv_valid": torch.from_numpy(valid)}
        if "depth_path" in contents:
            depth = decode_depth(contents["depth_path"], names["depth_path"])
            _same_size(depth, size, names["depth_path"])
            labels["depth"] = torch.from_numpy(depth)
    except DataError:
        raise
    except UikaError as error:
        raise DataError(str(error)) from error
    parameters = None
    shared = shared_arrays(canonical, where)[0]
    if "flame_param_path" in contents:
        name = names["flame_param_path"]
        own = read_arrays(contents["flame_param_path"], name)
        shared = shared_arrays(own, name)[0] | shared
        parameters = _parameters(own | shared, name)
    offset = shared.get("static_offset")
    return Sample(
        key=f"{identity}_{frame.timestep:05d}_{frame.camera_id}",
        identity=identity.partition("_")[0],
        timestep=frame.timestep,
        camera_id=frame.camera_id,
        image=torch.from_numpy(image).permute(2, 0, 1).float() / 255,
        mask=torch.from_numpy(mask).float() / 255,
        camera=_camera(frame, size[0], size[1], where),
        parameters=parameters,
        static_offset=None if offset is None else torch.from_numpy(offset),
        **labels,
    )


def shared_arrays(arrays: Mapping[str, np.ndarray], name: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays `SHARED` of a parameter file, float32, and sentences on what was left out of them.

    An offset of VHAP's FLAME loses its teeth, which lie behind the 5,023 vertices that every FLAME model has.

    Raises:
        DataError: the offset has another shape than [V,3]; the message says `name`.
    """
    found = {key: arrays[key].astype(np.float32) for key in SHARED if key in arrays}
    notes = []
    if (offset := found.get("static_offset")) is not None:
        if offset.size % 3 or offset.shape[-1] != 3:
            raise DataError(f"{name}: array 'static_offset' has the shape {offset.shape}, not [V,3]")
        offset = offset.reshape(-1, 3)
        if len(offset) == TRACKED_VERTICES:
            offset = offset[:FLAME_VERTICES]
            notes.append(
                f"{name}: 'static_offset' has {TRACKED_VERTICES:,} vertices; the {TRACKED_VERTICES - FLAME_VERTICES} "
                "of the teeth are left out"
            )
        found["static_offset"] = offset
    return found, notes


def read_arrays(data: bytes, name: str) -> dict[str, np.ndarray]:
    """Arrays of an `.npz` file's bytes; nothing in it is executed.

    Raises:
        DataError: it is not such a file, or an array holds no finite real numbers; the message says `name`.
    """
    try:
        arrays = read_npz(data)
    except ArraysError as error:
        raise DataError(f"{name}: cannot be read as an .npz of plain arrays ({error})") from error
    for key, array in arrays.items():
        if not np.issubdtype(array.dtype, np.number) or not np.isfinite(array).all():
            raise DataError(f"{name}: array '{key}' holds values that are not finite numbers")
    return arrays


def _parameters(arrays: Mapping[str, np.ndarray], name: str) -> HeadParameters:
    def row(key: str, size: int | None = None) -> Tensor:
        if key not in arrays:
            raise DataError(f"{name}: lacks the array '{key}'")
        values = torch.from_numpy(np.asarray(arrays[key], np.float32)).flatten()
        if size is not None and len(values) != size:
            raise DataError(f"{name}: array '{key}' has {len(values)} values where {size} are needed")
        return values

    pose: dict[str, Any] = {field: row(key, size) for field, (key, size) in _POSE.items()}
    return HeadParameters(row("shape"), row("expr"), translation=row("translation", 3), **pose)


def _camera(frame: Frame, height: int, width: int, where: str) -> Camera:
    to_world = torch.tensor(frame.matrix, dtype=torch.float64)
    to_world[:3, 1:3] *= -1
    fx, fy, cx, cy = frame.lens
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    viewmat, failed = torch.linalg.inv_ex(to_world)
    if int(failed) or not bool(torch.isfinite(viewmat.float()).all()):
        raise DataError(f"{where}: the transform_matrix of timestep {frame.timestep} cannot be inverted")
    return Camera(viewmat.float(), K, width, height)


def _same_size(array: np.ndarray, size: tuple[int, ...], name: str) -> None:
    if array.shape[:2] != size:
        raise DataError(f"{name}: has {array.shape[1]}x{array.shape[0]} pixels, its image {size[1]}x{size[0]}")
