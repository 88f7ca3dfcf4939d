"""A rigged, textured mesh as binary glTF: joints, skin, morph targets, and the motion as an animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.export.mesh import SkinnedMesh, skinned_mesh
from uika.export.texture import SIZE, as_png, bake_texture
from uika.head import HeadModel
from uika.head.model import JOINT_NAMES, JOINT_PARENTS
from uika.io.files import check_output
from uika.io.glb import INDICES, VERTICES, Glb
from uika.motion import Motion

UNLIT = "KHR_materials_unlit"  # the texture holds the photos' own light
_CLAMP = 33071
MESH_NODE = len(JOINT_NAMES)  # joints come first


def write_rigged_glb(
    path: str | Path, avatar: Avatar, head: HeadModel, motion: Motion | None = None, size: int = SIZE
) -> SkinnedMesh:
    """Write the avatar's mesh with its texture, skeleton, morph targets and, with a motion, one animation.

    Args:
        path: `.glb` file.
        avatar: the avatar.
        head: the head model that it was made for.
        motion: what the animation plays; a camera path in it is left out.
        size: side of each texture in texels.

    Returns:
        The mesh that was written.

    Raises:
        UikaError: wrong extension, nothing can be written there, or the head model is another one.
    """
    check_output(path, ".glb")
    mesh = skinned_mesh(avatar, head)
    file = Glb(avatar.provenance)
    add_mesh(file, mesh, [bake_texture(avatar, head, tile, size) for tile in mesh.faces])
    if motion is not None:
        add_animation(file, mesh, motion)
    file.write(path)
    return mesh


def add_mesh(file: Glb, mesh: SkinnedMesh, textures: list[NDArray[np.uint8]]) -> None:
    """Add nodes 0 to 4 (joints), node 5 (the skinned mesh), materials and the scene."""
    attributes = {
        "POSITION": file.add(mesh.positions, VERTICES, bounds=True),
        "NORMAL": file.add(mesh.normals, VERTICES),
        "TEXCOORD_0": file.add(mesh.uvs, VERTICES),
        "JOINTS_0": file.add(mesh.joint_ids, VERTICES),
        "WEIGHTS_0": file.add(mesh.weights, VERTICES),
    }
    targets = [{"POSITION": file.add(moved, VERTICES, bounds=True)} for moved in mesh.morphs.values()]
    primitives = [
        {
            "attributes": attributes,
            "indices": file.add(faces.flatten(), INDICES),
            "material": number,
            "targets": targets,
        }
        for number, faces in enumerate(mesh.faces.values())
    ]
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(JOINT_NAMES), 1, 1))
    inverse[:, 3, :3] = -mesh.joints  # column-major
    skin = {
        "joints": list(range(len(JOINT_NAMES))),
        "inverseBindMatrices": file.add(inverse.reshape(-1, 16)),
        "skeleton": 0,
    }
    names = list(mesh.morphs)
    file.document.update(
        extensionsUsed=[UNLIT],
        scene=0,
        scenes=[{"nodes": [0, MESH_NODE]}],
        nodes=[*_joint_nodes(mesh), {"name": "head", "mesh": 0, "skin": 0}],
        meshes=[
            {
                "name": "head",
                "primitives": primitives,
                "weights": [0.0] * len(names),
                "extras": {"targetNames": names},
            }
        ],
        skins=[skin],
        images=[{"bufferView": file.view(as_png(picture)), "mimeType": "image/png"} for picture in textures],
        samplers=[{"wrapS": _CLAMP, "wrapT": _CLAMP}],
        textures=[{"source": number, "sampler": 0} for number in range(len(textures))],
        materials=[
            {
                "name": f"skin{number}",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": number},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "doubleSided": True,
                "extensions": {UNLIT: {}},
            }
            for number in range(len(textures))
        ],
    )


def add_animation(file: Glb, mesh: SkinnedMesh, motion: Motion) -> None:
    """Add the motion: rotations of the joints, translation of the root, weights of the morph targets."""
    times = file.add((np.arange(len(motion)) / motion.fps).astype(np.float32), bounds=True)
    turns = (motion.rotation, motion.neck, motion.jaw, motion.eyes[:, :3], motion.eyes[:, 3:])
    curves = [(node, "rotation", quaternions(turn)) for node, turn in enumerate(turns) if bool((turn != 0).any())]
    if bool((motion.translation != 0).any()):
        curves.append((0, "translation", mesh.joints[0] + motion.translation.numpy()))
    curves.append((MESH_NODE, "weights", motion.expression.numpy().reshape(-1)))
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for node, kind, values in curves:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": kind}})
        samplers.append({"input": times, "output": file.add(values.astype(np.float32)), "interpolation": "LINEAR"})
    file.document["animations"] = [{"name": "motion", "channels": channels, "samplers": samplers}]


def quaternions(turn: Tensor) -> NDArray[np.float32]:
    """Unit quaternions [T,4] (xyzw) of axis-angle vectors [T,3], each on the side of the one before."""
    angle = turn.double().norm(dim=-1, keepdim=True)
    scale = torch.where(angle > 1e-9, torch.sin(angle / 2) / angle.clamp_min(1e-9), 0.5)
    result = torch.cat((turn.double() * scale, torch.cos(angle / 2)), -1).numpy()
    flips = np.sign((result[1:] * result[:-1]).sum(-1))
    result[1:] *= np.cumprod(np.where(flips < 0, -1, 1))[:, None]
    return result.astype(np.float32)


def _joint_nodes(mesh: SkinnedMesh) -> list[dict[str, Any]]:
    nodes = []
    for joint, (name, parent) in enumerate(zip(JOINT_NAMES, JOINT_PARENTS, strict=True)):
        place = mesh.joints[joint] - (mesh.joints[parent] if parent >= 0 else 0)
        node: dict[str, Any] = {"name": name, "translation": place.tolist()}
        children = [child for child, other in enumerate(JOINT_PARENTS) if other == joint]
        nodes.append({**node, "children": children} if children else node)
    return nodes
