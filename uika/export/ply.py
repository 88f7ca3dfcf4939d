"""Splat `.ply` files: canonical or posed, bound to the mesh, or one for each frame of a motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.errors import UikaError
from uika.export.splats import Splats, posed_splats
from uika.head import HeadModel
from uika.head.rotations import matrices_to_quaternions, multiply_quaternions
from uika.io.files import check_folder, check_output, replacing
from uika.io.progress import counted
from uika.motion import Motion

_FLAME_SHAPES, _FLAME_EXPRESSIONS = 300, 100


def write_ply(path: str | Path, splats: Splats, provenance: Mapping[str, str] | None = None) -> None:
    """Write Gaussians in the layout of 3DGS.

    Args:
        path: `.ply` file.
        splats: Gaussians in the axes that the reader assumes; most viewers assume Y down (`Splats.half_turned()`).
        provenance: written as comments into the header.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    from drjit_splat import save_ply

    target = check_output(path, ".ply")
    target.parent.mkdir(parents=True, exist_ok=True)
    save_ply(
        target,
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        splats.colors,
        comments=[f"{key}: {value}" for key, value in (provenance or {}).items()],
    )


def write_ply_sequence(
    folder: str | Path, avatar: Avatar, motion: Motion, head: HeadModel, *, y_down: bool = True, progress: bool = False
) -> int:
    """Write `frame_00000.ply` and so on, one file for each frame of a motion.

    Returns:
        The number of files.

    Raises:
        UikaError: the folder cannot be made or written to.
    """
    place = check_folder(folder)
    params = motion.parameters(avatar.identity)
    for index in counted(range(len(motion)), progress, len(motion), "frames"):
        splats = posed_splats(avatar, head, params[index])
        write_ply(place / f"frame_{index:05d}.ply", splats.half_turned() if y_down else splats, avatar.provenance)
    return len(motion)


def write_bound_ply(path: str | Path, avatar: Avatar, head: HeadModel) -> Path | None:
    """Write Gaussians as GaussianAvatars binds them: relative to a triangle, with its number in `binding_0`.

    Each Gaussian's centre, rotation and scale are those of the canonical avatar seen from its triangle's centre, axes
    and size (see `triangle_frames`). There is no turn to Y down: the triangles say where the head is.

    Args:
        path: `.ply` file.
        avatar: the avatar.
        head: the head model that it was made for.

    Returns:
        The file `flame_param.npz` that was written beside it with the identity at rest, if the head is a FLAME head;
        None for another head, which GaussianAvatars itself cannot move. FLAME ends at the neck: a bust is left out.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    from drjit_splat import save_ply

    target = check_output(path, ".ply")
    target.parent.mkdir(parents=True, exist_ok=True)
    flame = head.id.startswith("flame-")
    if flame and head.bust is not None and len(avatar.static_offset) == len(head.template):
        avatar, head = _without_bust(avatar, head), head.without_bust
    centre, rotation, size = triangle_frames(avatar.canonical_vertices(head), head.faces)
    turn, length = rotation[avatar.triangle], size[avatar.triangle][:, None]
    local = (turn.mT @ (avatar.means - centre[avatar.triangle])[..., None])[..., 0] / length
    save_ply(
        target,
        local,
        multiply_quaternions(matrices_to_quaternions(rotation.mT)[avatar.triangle], avatar.quats),
        avatar.scales / length,
        avatar.opacities,
        avatar.colors,
        extra={"binding_0": avatar.triangle.float()},
        comments=[f"{key}: {value}" for key, value in avatar.provenance.items()],
    )
    return _write_flame(target, avatar, head) if flame else None


def _without_bust(avatar: Avatar, head: HeadModel) -> Avatar:
    """The avatar of the head alone: other programs' FLAME ends at the neck."""
    assert head.bust is not None
    kept = avatar.triangle < head.bust.face
    names = ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric")
    parts: dict[str, Any] = {name: getattr(avatar, name)[kept] for name in names}
    offset = avatar.static_offset[: head.bust.vertex]
    return replace(avatar, head_id=head.bust.head_id, static_offset=offset, bust_triangle=None, **parts)


def triangle_frames(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centres [F,3], rotations [F,3,3] and sizes [F] of the triangles of a mesh [V,3], as GaussianAvatars defines them.

    The columns of a rotation are the first edge, the normal, and the direction square to both; the size is the mean of
    the first edge and the height above it.
    """
    a, b, c = vertices[faces].unbind(1)
    along = torch.nn.functional.normalize(b - a, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(along, c - a), dim=-1)
    across = torch.linalg.cross(along, normal)
    size = ((b - a).norm(dim=-1) + ((c - a) * across).sum(-1).abs()) / 2
    return (a + b + c) / 3, torch.stack((along, normal, across), -1), size


def _write_flame(target: Path, avatar: Avatar, head: HeadModel) -> Path:
    beside = target.with_name("flame_param.npz")
    if len(avatar.identity) > _FLAME_SHAPES or len(head.expression_names) > _FLAME_EXPRESSIONS:
        raise UikaError(f"{beside}: FLAME parameters hold at most 300 shapes and 100 expressions")
    sizes = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3, "expr": 100}
    arrays = {name: np.zeros((1, size), np.float32) for name, size in sizes.items()}
    shape = np.zeros(_FLAME_SHAPES, np.float32)
    shape[: len(avatar.identity)] = avatar.identity.numpy()
    with replacing(beside) as temporary, temporary.open("wb") as file:
        np.savez(file, shape=shape, static_offset=avatar.static_offset.numpy()[None], **arrays)  # type: ignore[arg-type]
    return beside
