"""A made-up scene, its pictures, and the ways in which other programs write such data down."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from drjit_splat import rasterization

SIZE, COUNT = 48, 12


def look_at(position: torch.Tensor) -> torch.Tensor:
    """World to camera, towards the origin, OpenCV axes, Z up."""
    forward = torch.nn.functional.normalize(-position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    turn = torch.stack((right, torch.linalg.cross(forward, right), forward))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ position
    return viewmat


def cameras() -> tuple[torch.Tensor, torch.Tensor]:
    """View matrices [COUNT,4,4] around the scene, and K [3,3]."""
    angle = torch.arange(COUNT) * (2 * torch.pi / COUNT)
    place = torch.stack((3 * angle.cos(), 3 * angle.sin(), 0.7 + 0.5 * (3 * angle).sin()), -1)
    K = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]])
    return torch.stack([look_at(each) for each in place]), K


def scene() -> dict[str, torch.Tensor]:
    """Coloured blobs."""
    generator = torch.Generator().manual_seed(5)
    return {
        "means": 1.4 * torch.rand(40, 3, generator=generator) - 0.7,
        "quats": torch.randn(40, 4, generator=generator),
        "scales": 0.08 + 0.15 * torch.rand(40, 3, generator=generator),
        "opacities": 0.6 + 0.4 * torch.rand(40, generator=generator),
        "colors": torch.rand(40, 3, generator=generator),
    }


def write_pictures(folder: Path) -> list[str]:
    """The scene from every camera on white; names in order."""
    viewmats, K = cameras()
    images, _, _ = rasterization(
        **scene(),
        viewmats=viewmats,
        Ks=K.expand(COUNT, 3, 3),
        width=SIZE,
        height=SIZE,
        backgrounds=torch.ones(COUNT, 3),
    )
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{index:03d}.png" for index in range(COUNT)]
    for name, image in zip(names, images, strict=True):
        Image.fromarray((image.clamp(0, 1) * 255).round().byte().numpy()).save(folder / name)
    return names


def write_nerfstudio(folder: Path, **changes: object) -> Path:
    """`transforms.json` beside `images`."""
    names = write_pictures(folder / "images")
    viewmats, K = cameras()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(v.double().numpy()) @ flip).tolist()}
        for name, v in zip(names, viewmats, strict=True)
    ]
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    document = {"w": SIZE, "h": SIZE, **lens, "frames": frames, **changes}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def quaternion(turn: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix."""
    return np.roll(Rotation.from_matrix(turn).as_quat(), 1)


def write_colmap(folder: Path, *, binary: bool, model: int = 1) -> Path:
    """`sparse/0` beside `images`, with the scene's means as points."""
    names = write_pictures(folder / "images")
    viewmats, K = cameras()
    tables = folder / "sparse" / "0"
    tables.mkdir(parents=True, exist_ok=True)
    lens = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])] + [0.01] * (4 if model == 4 else 0)
    poses = [(quaternion(v[:3, :3].double().numpy()), v[:3, 3].double().numpy()) for v in viewmats]
    points, colors = scene()["means"].double().numpy(), (scene()["colors"] * 255).round().int().numpy()
    if binary:
        (tables / "cameras.bin").write_bytes(
            struct.pack("<QiiQQ", 1, 7, model, SIZE, SIZE) + struct.pack(f"<{len(lens)}d", *lens)
        )
        rows = [
            struct.pack("<i7di", index + 1, *quat, *shift, 7)
            + name.encode()
            + b"\0"
            + struct.pack("<Q2dq", 1, 3.0, 4.0, 2)
            for index, (name, (quat, shift)) in enumerate(zip(names, poses, strict=True))
        ]
        (tables / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
        cloud = [
            struct.pack("<Q3d3BdQ2i", index, *point, *color, 0.5, 1, 1, 0)
            for index, (point, color) in enumerate(zip(points, colors, strict=True))
        ]
        (tables / "points3D.bin").write_bytes(struct.pack("<Q", len(cloud)) + b"".join(cloud))
        return folder
    name_of = {1: "PINHOLE", 4: "OPENCV"}[model]
    (tables / "cameras.txt").write_text(f"# cameras\n7 {name_of} {SIZE} {SIZE} {' '.join(map(str, lens))}\n")
    lines = ["# images"]
    for index, (name, (quat, shift)) in enumerate(zip(names, poses, strict=True)):
        lines += [f"{index + 1} {' '.join(map(str, (*quat, *shift)))} 7 {name}", "3.0 4.0 2"]
    (tables / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{i} {' '.join(map(str, (*p, *c)))} 0.5 1 0" for i, (p, c) in enumerate(zip(points, colors, strict=True))]
    (tables / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder
