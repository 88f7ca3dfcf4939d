"""One frame of the avatar's mesh as Wavefront `.obj`, with material and textures beside it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from uika.avatar import Avatar
from uika.export.mesh import skinned_mesh
from uika.export.texture import SIZE, as_png, bake_texture
from uika.head import HeadModel, HeadParameters, pose_vertices, vertex_normals
from uika.io.files import check_output, replacing


def write_obj(
    path: str | Path, avatar: Avatar, head: HeadModel, params: HeadParameters | None = None, size: int = SIZE
) -> list[Path]:
    """Write `NAME.obj`, `NAME.mtl` and one `NAME_N.png` for each UV tile; metres, Y up.

    Args:
        path: `.obj` file.
        avatar: the avatar.
        head: the head model that it was made for.
        params: expression and pose; None is the neutral face.
        size: side of each texture in texels.

    Returns:
        The files beside the `.obj`.

    Raises:
        UikaError: wrong extension, nothing can be written there, or the head model is another one.
    """
    target = check_output(path, ".obj")
    mesh = skinned_mesh(avatar, head)
    posed = avatar.canonical_vertices(head)
    if params is not None:
        posed = pose_vertices(head, params.replace(identity=avatar.identity), avatar.static_offset)
    points, normals = posed[mesh.vertex].numpy(), vertex_normals(posed, head.faces)[mesh.vertex].numpy()
    pictures = {tile: target.with_name(f"{target.stem}_{tile}.png") for tile in mesh.faces}
    material = target.with_suffix(".mtl")
    lines = [f"mtllib {material.name}", "o head"]
    for word, rows in (("v", points), ("vt", mesh.uvs * (1, -1) + (0, 1)), ("vn", normals)):
        lines += [f"{word} " + " ".join(f"{value:.6f}" for value in row) for row in rows]
    for tile, faces in mesh.faces.items():
        lines.append(f"usemtl skin{tile}")
        lines += ["f " + " ".join(f"{i}/{i}/{i}" for i in face) for face in (faces.astype(np.int64) + 1).tolist()]
    looks = [
        f"newmtl skin{tile}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {p.name}\n" for tile, p in pictures.items()
    ]
    with ExitStack() as stack:  # all of them, or none
        opened = {p: stack.enter_context(replacing(p)) for p in (*pictures.values(), material, target)}
        for tile, picture in pictures.items():
            opened[picture].write_bytes(as_png(bake_texture(avatar, head, tile, size)))
        opened[material].write_text("\n".join(looks), encoding="utf-8")
        opened[target].write_text("\n".join([*lines, ""]), encoding="utf-8")
    return [material, *pictures.values()]
