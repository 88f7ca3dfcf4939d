"""Plain arrays for other programs to pose the avatar themselves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from uika.avatar import Avatar
from uika.head import HeadModel, pose_vertices
from uika.io.files import check_output, replacing
from uika.motion import Motion


def write_npz(path: str | Path, avatar: Avatar, head: HeadModel, motion: Motion | None = None) -> None:
    """Write the canonical Gaussians, their binding, the mesh and, with a motion, the mesh in each frame.

    Arrays: `means`, `quats` (wxyz), `scales`, `opacities`, `colors`, `triangle`, `barycentric`, `faces` [F,3],
    `vertices` [V,3] of the canonical mesh, `provenance` (JSON), and with a motion `frames` [T,V,3] and `fps`; metres,
    Y up. `uika.head.pose_gaussians` takes them as they are.

    Args:
        path: `.npz` file.
        avatar: the avatar.
        head: the head model that it was made for.
        motion: movement to add.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    target = check_output(path, ".npz")
    names = ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric")
    arrays = {name: getattr(avatar, name).numpy() for name in names}
    arrays["faces"], arrays["vertices"] = head.faces.numpy(), avatar.canonical_vertices(head).numpy()
    arrays["provenance"] = np.array(json.dumps(dict(avatar.provenance), sort_keys=True))
    if motion is not None:
        posed = pose_vertices(head, motion.parameters(avatar.identity), avatar.static_offset)
        arrays["frames"], arrays["fps"] = posed.numpy(), np.float64(motion.fps)
    with replacing(target) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
