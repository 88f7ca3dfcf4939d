"""Files that the page offers to save."""

from __future__ import annotations

import tempfile
from pathlib import Path

from uika import export
from uika.avatar import Avatar
from uika.head import Camera, HeadModel, HeadParameters
from uika.motion import Motion

KINDS = (".ply", ".splat", ".glb", ".html", ".npz", ".png")


def exported(
    kind: str, avatar: Avatar, head: HeadModel, params: HeadParameters, motion: Motion, camera: Camera, watermark: bool
) -> bytes:
    """The file of one of `KINDS`: the pose as it is, the whole motion (.html, .npz), or a picture (.png)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"avatar{kind}"
        if kind == ".html":
            export.write_html(path, avatar, motion, head)
        elif kind == ".npz":
            export.write_npz(path, avatar, head, motion)
        elif kind == ".png":
            _picture(path, avatar, head, params, camera, watermark)
        else:
            splats = export.posed_splats(avatar, head, params)
            if kind == ".ply":
                export.write_ply(path, splats.half_turned(), avatar.provenance)
            elif kind == ".splat":
                export.write_splat(path, splats.half_turned())
            else:
                export.write_glb(path, splats, avatar.provenance)
        return path.read_bytes()


def _picture(
    path: Path, avatar: Avatar, head: HeadModel, params: HeadParameters, camera: Camera, watermark: bool
) -> None:
    from uika.avatar.rendering import render
    from uika.io.video import write_png
    from uika.safeguards import mark, picture_provenance

    rgb = render(avatar, params, camera, head).rgb
    write_png(path, mark(rgb) if watermark else rgb, picture_provenance(avatar, watermark=watermark))
