"""Captures as VHAP's export writes them: names, types, shapes and the poses in the canonical file; made-up people."""

import json
import math
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from tests.flame_files import flame_arrays
from uika.head import Camera, HeadModel, HeadParameters, look_at, pose_vertices, project, rasterize, save_head
from uika.head_import import adopt
from uika.head_import.flame_file import read_flame

TEETH = 120  # rows that VHAP's FLAME has behind the model's vertices
SIZE = (138, 200)  # width and height of a frame, an eighth of NeRSemble's
CAMERAS = ("222200036", "222200037", "222200040")  # NeRSemble's names
POSES = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
CANONICAL_JAW = 0.3


@lru_cache(maxsize=1)
def bare_flame() -> HeadModel:
    """A head with FLAME's sizes and coefficients but not its data, without landmarks and masks."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flame.npz"
        np.savez(path, **flame_arrays())  # type: ignore[arg-type]
        return read_flame(path)


@lru_cache(maxsize=1)
def made_up_flame() -> HeadModel:
    """The same with landmarks and masks, which take seconds."""
    return adopt(bare_flame())


def write_flame(path: Path) -> Path:
    save_head(made_up_flame(), path)
    return path


def tracked(seed: int, frames: int) -> dict[str, np.ndarray]:
    """What VHAP tracks: a moving head, arrays over all time steps."""
    random = np.random.default_rng(seed)
    place = np.arange(frames)[:, None] + random.uniform(0, 9)
    scale = {"rotation": 0.15, "neck_pose": 0.1, "jaw_pose": 0.0, "eyes_pose": 0.1, "translation": 0.004}
    arrays = {
        name: (scale[name] * np.sin(place * random.uniform(0.5, 1.5, size) + random.uniform(0, 6, size)))
        for name, size in POSES.items()
    }
    arrays["jaw_pose"][:, 0] = 0.1 + 0.1 * np.sin(place[:, 0])
    arrays["translation"] -= arrays["translation"].mean(0)
    expression = np.zeros((frames, 100))
    expression[:, :20] = 0.4 * np.sin(place * random.uniform(0.5, 1.5, 20))
    shape = np.zeros(300)
    shape[:20] = random.normal(size=20)
    offset = np.zeros((1, 5023 + TEETH, 3))
    offset[0, :5023] = 0.002 * np.sin(60 * bare_flame().template.numpy())
    offset[0, 5023:] = 9.0  # teeth must reach nothing
    arrays |= {"expr": expression, "shape": shape, "static_offset": offset}
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def write_export(folder: Path, seed: int = 0, frames: int = 4, cameras: int = 3, distance: float = 1.0) -> Path:
    """One sequence, painted by position on white."""
    arrays = tracked(seed, frames)
    for kind in ("images", "fg_masks", "flame_param"):
        (folder / kind).mkdir(parents=True)
    entries = []
    for step in range(frames):
        pose = {name: arrays[name][[step]] for name in (*POSES, "expr")}
        own: dict[str, Any] = {**pose, "shape": arrays["shape"], "static_offset": arrays["static_offset"]}
        np.savez(folder / f"flame_param/{step:05d}.npz", **own)
        for index in range(cameras):
            camera = place_camera(25.0 * (index - cameras // 2), distance)
            name = f"{step:05d}_{index:02d}.png"
            rgb, mask = picture(parameters(arrays, step), arrays["static_offset"], camera, seed)
            Image.fromarray(rgb).save(folder / "images" / name)
            Image.fromarray(mask).save(folder / "fg_masks" / name)
            entries.append(_entry(step, index, camera, name))
    rest = {name: np.zeros((1, size), np.float32) for name, size in (*POSES.items(), ("expr", 100))}
    rest["jaw_pose"] = np.array([[CANONICAL_JAW, 0, 0]])
    shared: dict[str, Any] = {**rest, "shape": arrays["shape"], "static_offset": arrays["static_offset"]}
    np.savez(folder / "canonical_flame_param.npz", **shared)
    base = {name: entries[-1][name] for name in ("cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x")}
    steps, views = list(range(frames)), list(range(cameras))
    _save(folder, "", {"frames": entries, **base, "timestep_indices": steps, "camera_indices": views})
    _save(folder, "_backup", {"frames": [], **base})
    train = [entry for entry in entries if entry["camera_index"] != views[-1]]
    _save(folder, "_train", {**base, "frames": train, "timestep_indices": steps, "camera_indices": views[:-1]})
    return folder


def write_union(folder: Path, sequences: list[Path]) -> Path:
    """Several sequences beside the folder, joined: descriptions in three parts, paths that lead to the sequences."""
    parts: dict[str, list[dict[str, Any]]] = {"train": [], "val": [], "test": []}
    start = 0
    for place, sequence in enumerate(sequences):
        content = json.loads((sequence / "transforms.json").read_text())
        last = place == len(sequences) - 1
        for entry in content["frames"]:
            del entry["timestep_index_original"], entry["timestep_id"]
            entry["timestep_index"] += start
            for name in ("file_path", "fg_mask_path", "flame_param_path"):
                entry[name] = f"../{sequence.name}/{entry[name]}"
            kind = "test" if last else "val" if entry["camera_index"] == 2 else "train"
            parts[kind].append(entry)
        start += len(content["timestep_indices"])
    folder.mkdir()
    for kind, entries in parts.items():
        _save(folder, f"_{kind}", {"frames": entries})
    first = sequences[0] / "canonical_flame_param.npz"
    (folder / first.name).write_bytes(first.read_bytes())
    return folder


def parameters(arrays: dict[str, np.ndarray], step: int) -> HeadParameters:
    names = {"rotation": "rotation", "neck": "neck_pose", "jaw": "jaw_pose", "eyes": "eyes_pose"}
    pose = {field: torch.from_numpy(arrays[name][step]) for field, name in names.items()}
    return HeadParameters(
        torch.from_numpy(arrays["shape"]),
        torch.from_numpy(arrays["expr"][step]),
        translation=torch.from_numpy(arrays["translation"][step]),
        **pose,
    )


def place_camera(yaw: float, distance: float) -> Camera:
    return look_at(yaw, 0.0, distance, (0.0, 0.0, 0.0), fov_y=30.0, size=SIZE)


def picture(params: HeadParameters, offset: np.ndarray, camera: Camera, seed: int) -> tuple[np.ndarray, np.ndarray]:
    head = bare_flame()
    vertices = pose_vertices(head, params, torch.from_numpy(offset[0, :5023]))
    points, depth = project(vertices, camera)
    triangle, mix = rasterize(points, head.faces, camera.height, camera.width, depth=depth, cull="back")
    hit, at = triangle >= 0, triangle.clamp(min=0)
    paint = 0.5 + 0.4 * torch.sin(head.template[head.faces[at]] * 60 + seed)
    rgb = torch.where(hit[..., None], (paint * mix[..., None]).sum(-2), 1.0)
    return (255 * rgb).round().to(torch.uint8).numpy(), (255 * hit).to(torch.uint8).numpy()


def _entry(step: int, index: int, camera: Camera, name: str) -> dict[str, Any]:
    to_world = torch.linalg.inv(camera.viewmat.double())
    to_world[:3, 1:3] *= -1
    K = camera.K.double()
    return {
        "timestep_index": step,
        "timestep_index_original": step,
        "timestep_id": f"frame_{step:05d}",
        "camera_index": index,
        "camera_id": CAMERAS[index],
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "h": camera.height,
        "w": camera.width,
        "camera_angle_x": 2 * math.atan(camera.width / (2 * float(K[0, 0]))),
        "camera_angle_y": 2 * math.atan(camera.height / (2 * float(K[1, 1]))),
        "transform_matrix": to_world.tolist(),
        "file_path": f"images/{name}",
        "fg_mask_path": f"fg_masks/{name}",
        "flame_param_path": f"flame_param/{step:05d}.npz",
    }


def _save(folder: Path, division: str, content: dict[str, Any]) -> None:
    (folder / f"transforms{division}.json").write_text(json.dumps(content, indent=4))
