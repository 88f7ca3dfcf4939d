"""Readers of files that may come from strangers: small good files, how to damage them, how to read them."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from drjit_splat import load_ply, save_ply
from tests.drjit_splat.common import random_scene
from tests.flame_files import write_pickle
from tests.heads import sphere_head
from uika import Avatar
from uika.avatar import AvatarError
from uika.data import DataError, open_capture, shard_samples, write_shard
from uika.data.encode import encode_pixels
from uika.head import HeadError, load_head, save_head
from uika.head.actions import ARKIT_ACTIONS
from uika.head_import.unpickle import UnpickleError, read_arrays
from uika.motion import (
    Motion,
    MotionError,
    load_motion,
    read_csv,
    read_flame_params,
    read_json,
    save_motion,
    write_csv,
    write_flame_params,
    write_json,
)
from uika.photo import PhotoError
from uika.photo.read import read

from . import more_targets, mutate, outside_targets, recordings, splat_targets


@dataclass(frozen=True)
class Target:
    """One reader."""

    seeds: Callable[[Path], list[Path]]  # writes good files into a folder
    mutate: mutate.Mutator
    read: Callable[[Path], Any]
    refusal: type[Exception]  # the only exception that damage may raise


def _pictures(folder: Path) -> list[Path]:
    noise = np.random.default_rng(0).integers(0, 256, (72, 80, 3), np.uint8)
    smooth = Image.fromarray(noise).resize((10, 9)).resize((80, 72))
    exif = Image.Exif()
    exif[0x0112] = 6
    made = []
    for name, kind, mode, options in (
        ("a.jpg", "JPEG", "RGB", {"exif": exif}),
        ("b.jpg", "JPEG", "CMYK", {"progressive": True}),
        ("c.png", "PNG", "RGB", {}),
        ("d.png", "PNG", "RGBA", {"exif": exif}),
        ("e.png", "PNG", "P", {"transparency": 3}),
        ("f.webp", "WEBP", "RGB", {"lossless": True}),
        ("g.webp", "WEBP", "RGBA", {}),
    ):
        smooth.convert(mode).save(folder / name, kind, **options)
        made.append(folder / name)
    (folder / "h.png").write_bytes(encode_pixels(noise[..., 0].astype(np.uint16) * 257))
    try:
        import pillow_heif
    except ImportError:
        return [*made, folder / "h.png"]
    pillow_heif.register_heif_opener()
    smooth.save(folder / "i.heic", "HEIF")
    return [*made, folder / "h.png", folder / "i.heic"]


def _avatars(folder: Path) -> list[Path]:
    count, path = 5, folder / "a.safetensors"
    scene = random_scene(count=count)
    splats = {name: scene[name] for name in ("means", "quats", "scales", "opacities", "colors")}
    Avatar(
        head_id="builtin-1",
        identity=torch.zeros(3),
        static_offset=torch.zeros(4, 3),
        triangle=torch.arange(count),
        barycentric=torch.full((count, 3), 1 / 3),
        provenance={"photos": "1", "consent": "yes"},
        **splats,
    ).save(path)
    return [path]


def _splats(folder: Path) -> list[Path]:
    scene = random_scene(count=6)
    splats = {name: scene[name] for name in ("means", "quats", "scales", "opacities")}
    paths = [folder / f"{degree}.ply" for degree in (0, 1)]
    for degree, path in enumerate(paths):
        save_ply(path, **splats, colors=torch.zeros(6, (degree + 1) ** 2, 3), comments=["made: here"])
    header, body = paths[0].read_bytes().split(b"end_header\n")
    words = " ".join(f"{value:.6g}" for value in np.frombuffer(body, "<f4"))
    (folder / "t.ply").write_bytes(header.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + words.encode())
    return [*paths, folder / "t.ply"]


def _pickles(folder: Path) -> list[Path]:
    arrays: dict[str, Any] = {
        "v_template": np.arange(12.0).reshape(4, 3),
        "shapedirs": np.ones((4, 3, 2)),
        "J_regressor": np.eye(5, 4),
        "weights": np.ones((4, 5), np.float32),
        "f": np.array([[0, 1, 2]], np.uint32),
    }
    made = [write_pickle(folder / f"{protocol}.pkl", arrays, protocol) for protocol in (2, 4)]
    plain = folder / "plain.pkl"
    plain.write_bytes(pickle.dumps(arrays, protocol=1))
    return [*made, plain]


def _flame_motion(folder: Path) -> list[Path]:
    sizes = {"expression": 4, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    motion = Motion(fps=25.0, **{name: torch.full((2, size), 0.1) for name, size in sizes.items()})
    write_flame_params(motion, folder / "a.npz", torch.zeros(3))
    return [folder / "a.npz"]


def _heads(folder: Path) -> list[Path]:
    path = folder / "head.npz"
    save_head(sphere_head(rows=7, columns=10, identities=2, expressions=2), path)
    with np.load(path) as file:  # without the seal, so that damage reaches the checks behind it
        arrays = {name: file[name] for name in file.files if name != "sha256"}
    np.savez(path, **arrays)
    return [path]


def _actions(head_names: tuple[str, ...]) -> Motion:
    sizes = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    rest = {name: torch.zeros(4, size) for name, size in sizes.items()}
    return Motion(expression=torch.rand(4, len(head_names)), fps=2.0, **rest)


def _motions(folder: Path) -> list[Path]:
    head = sphere_head(rows=7, columns=10)
    save_motion(_actions(head.expression_names), folder / "a.npz", head)
    return [folder / "a.npz"]


def _tables(folder: Path) -> list[Path]:
    write_csv(_actions(ARKIT_ACTIONS), folder / "a.csv", ARKIT_ACTIONS)
    return [folder / "a.csv"]


def _poses(folder: Path) -> list[Path]:
    write_json(_actions(ARKIT_ACTIONS), folder / "a.json", ARKIT_ACTIONS)
    (folder / "b.json").write_text(json.dumps({"fps": 30, "names": ["jawOpen"], "frames": [[0.5], [0.1]]}))
    (folder / "c.json").write_text(json.dumps([{"blendShapes": {"jawOpen": 0.5}}]))
    return sorted(folder.glob("*.json"))


def _frame_files() -> dict[str, bytes]:
    """Contents of one frame's files by their extension in a shard."""
    image, flame = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (24, 16), (90, 60, 30)).save(image, "PNG")
    sizes = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3, "expr": 4, "shape": 3}
    np.savez(flame, **{name: np.zeros((1, size)) for name, size in sizes.items()})  # type: ignore[arg-type]
    deep = encode_pixels(np.full((32, 24), 5, np.uint16))
    mask = encode_pixels(np.full((16, 24), 200, np.uint8))
    return {"png": image.getvalue(), "mask.png": mask, "uv.png": deep, "depth.png": deep[:0], "npz": flame.getvalue()}


_ENTRY = {
    "timestep_index": 0,
    "camera_id": "00",
    **{"fl_x": 40.5, "fl_y": 41.5, "cx": 12.0, "cy": 8.0},
    "transform_matrix": [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]],
}


def captures(folder: Path) -> list[Path]:
    files = _frame_files()
    for name, key in (("a.png", "png"), ("m.png", "mask.png"), ("uv.png", "uv.png"), ("a.npz", "npz")):
        (folder / name).write_bytes(files[key])
    entry = _ENTRY | {"file_path": "a.png", "fg_mask_path": "m.png", "uv_path": "uv.png", "flame_param_path": "a.npz"}
    (folder / "transforms.json").write_text(json.dumps({"frames": [entry, entry]}))
    return [folder / "transforms.json"]


def _read_capture(path: Path) -> None:
    # Read where the other files lie, under the one name that it may have.
    place = path.parent.parent / "seeds" / "transforms.json"
    place.write_bytes(path.read_bytes())
    for _ in open_capture(place.parent, strict=True).samples(strict=True):
        pass


def _shards(folder: Path) -> list[Path]:
    files = _frame_files()
    canonical = io.BytesIO()
    np.savez(canonical, static_offset=np.zeros((7, 3)))
    entries = [("p_c.canonical.npz", canonical.getvalue())]
    for index in range(2):
        key = f"p_{index}"
        entries += [(f"{key}.json", json.dumps(_ENTRY).encode()), (f"{key}.png", files["png"])]
        entries += [(f"{key}.mask.png", files["mask.png"]), (f"{key}.flame.npz", files["npz"])]
    write_shard(folder / "a.tar", entries)
    return [folder / "a.tar"]


def _read_shard(path: Path) -> None:
    for _ in shard_samples(path, strict=True):
        pass


TARGETS = {
    "photo": Target(_pictures, mutate.png, read, PhotoError),
    "avatar": Target(_avatars, mutate.safetensors, Avatar.load, AvatarError),
    "ply": Target(_splats, mutate.ply, load_ply, ValueError),
    "flame_pickle": Target(_pickles, mutate.pickled, read_arrays, UnpickleError),
    "flame_motion": Target(_flame_motion, mutate.npz, read_flame_params, MotionError),
    "head": Target(_heads, mutate.npz, load_head, HeadError),
    "motion_npz": Target(
        _motions, mutate.npz, lambda path: load_motion(path, sphere_head(rows=7, columns=10)), MotionError
    ),
    "motion_csv": Target(_tables, mutate.text, read_csv, MotionError),
    "motion_json": Target(_poses, mutate.text, read_json, MotionError),
    "transforms": Target(captures, mutate.text, _read_capture, DataError),
    "shard": Target(_shards, mutate.tar, _read_shard, DataError),
}
for more in (more_targets.TARGETS, recordings.TARGETS, outside_targets.TARGETS, splat_targets.TARGETS):
    TARGETS |= {name: Target(*parts) for name, parts in more.items()}
