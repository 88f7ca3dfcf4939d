"""VRM animations made up for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uika.io.glb import Glb
from uika.motion.vrm_animation import EXTENSION

TIMES = np.array([0.0, 0.5, 1.0], np.float32)


def about(axis: str, degrees: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(np.outer(degrees, np.eye(3)["xyz".index(axis)]), degrees=True)


def turn(axis: str, *degrees: float) -> np.ndarray:
    return about(axis, np.array(degrees)).as_quat().astype(np.float32)


def written(path: Path, rest: float = 0.0, hips: float = 0.0, way: str = "LINEAR", **changes: Any) -> Path:
    """Hips that stand turned, a head that yaws by 0, 20 and 40 degrees above a spine that rests turned about X."""
    file = Glb()
    back = turn("x", -rest)[0]
    nodes: list[dict[str, Any]] = [
        {"name": "hips", "children": [1]},
        {"name": "spine", "rotation": turn("x", rest)[0].tolist(), "children": [2]},
        {"name": "head"},
        *({"name": name} for name in ("blink", "aa", "jawOpen", "tail", "lookAt")),
    ]
    head = (
        Rotation.from_quat(back) * Rotation.from_quat(turn("y", 0, 20, 40)) * Rotation.from_quat(back).inv()
    ).as_quat()
    tracks: dict[tuple[int, str], np.ndarray] = {
        (0, "rotation"): turn("y", hips, hips, hips),
        (2, "rotation"): head.astype(np.float32),
        (3, "translation"): np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]], np.float32),
        (5, "translation"): np.array([[0.25, 0, 0], [0.25, 0, 0], [1.5, 0, 0]], np.float32),
        (7, "rotation"): turn("y", 0, 10, 10),
    }
    samplers, channels = [], []
    for (node, what), values in tracks.items():
        if way == "CUBICSPLINE":
            values = np.stack((0 * values, values, 0 * values), 1).reshape(-1, values.shape[1])
        ends = {"input": file.add(changes.get("times", TIMES), bounds=True), "output": file.add(values)}
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": what}})
        samplers.append({**ends, "interpolation": way})
    roles = {
        "specVersion": "1.0",
        "humanoid": {"humanBones": {"hips": {"node": 0}, "spine": {"node": 1}, "head": {"node": 2}}},
        "expressions": {
            "preset": {"blink": {"node": 3}, "aa": {"node": 4}},
            "custom": {"jawOpen": {"node": 5}, **({"Tail": {"node": 6}} if changes.get("strange") else {})},
        },
        "lookAt": {"node": 7},
    }
    nodes[1]["children"] = changes.get("children", [2])
    file.document.update(
        scene=0,
        scenes=[{"nodes": [0]}],
        nodes=nodes,
        animations=[{"channels": channels, "samplers": samplers}],
        extensionsUsed=[EXTENSION],
        extensions={} if changes.get("plain") else {EXTENSION: roles},
    )
    file.write(path, ".vrma")
    return path
