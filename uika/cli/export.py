"""The command `uika export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from uika.errors import UikaError
from uika.io.files import check_folder, check_output

if TYPE_CHECKING:
    from uika.avatar import Avatar
    from uika.head import HeadModel
    from uika.motion import Motion

_KINDS = (".ply", ".splat", ".spz", ".glb", ".obj", ".vrm", ".html", ".npz")
_POSED = (".ply", ".splat", ".spz", ".glb", ".obj")  # hold one pose
_LARGEST = 8192  # texels; more than most graphics cards hold
_TURNED = (".ply", ".splat", "")


@dataclass(frozen=True)
class Export:
    """Write an avatar for another program; a folder gets one .ply for each frame of the motion.

    Example: uika export me.safetensors -o me.html --motion talk
    """

    avatar: Positional[Path]
    """The avatar file."""
    output: Annotated[Path, arg(aliases=["-o"])]
    """.ply, .splat, .spz, .glb, .obj, .vrm, .html, .npz, or a folder."""
    motion: str | None = None
    """orbit, talk, expressions or a motion file; an .html plays talk if left out."""
    frame: int | None = None
    """Frame of the motion that .ply, .splat, .spz, .glb and .obj show; without it they are canonical."""
    mesh: bool = False
    """Write a .glb with a textured, rigged mesh instead of Gaussians; --motion becomes its animation."""
    texture: int = 1024
    """Side of the textures of .obj and --mesh in texels."""
    with_binding: bool = False
    """Write a .ply relative to the triangles, as GaussianAvatars does."""
    axes: Literal["y-down", "y-up"] = "y-down"
    """Of .ply and .splat; most of their viewers assume Y down."""
    framing: Literal["bust", "head"] = "bust"
    """What an .html shows at first: the portrait with its shoulders, or the head alone."""
    count: int | None = None
    """Keep at most so many Gaussians."""

    def run(self) -> int:
        """Read, pose, write."""
        kind = self.output.suffix.lower()
        self._check(kind)
        from uika.avatar import Avatar
        from uika.export import thinned
        from uika.head import load_head
        from uika.motion.presets import get_motion

        avatar, head = Avatar.load(self.avatar), load_head()
        avatar.check_head(head)
        name = self.motion or ("talk" if kind == ".html" else None)
        motion = None if name is None else get_motion(name, head)
        if self.frame is not None and motion is not None and not 0 <= self.frame < len(motion):
            raise UikaError(f"--frame must lie between 0 and {len(motion) - 1}, not {self.frame}")
        if self.count is not None:
            avatar = thinned(avatar, self.count)
        if self.mesh or kind in (".obj", ".vrm"):
            said = self._write_mesh(kind, avatar, head, motion)
        else:
            said = f"{len(avatar):,} Gaussians{self._write(kind, avatar, head, motion)}"
        print(f"wrote {self.output}: {said}")
        return 0

    def _check(self, kind: str) -> None:
        if kind == "":
            check_folder(self.output)
            if self.motion is None or self.frame is not None:
                raise UikaError(f"{self.output}: a folder of .ply files needs --motion and no --frame")
        elif kind not in _KINDS:
            raise UikaError(f"{self.output}: the output's name must end in {', '.join(_KINDS)}, or name a folder")
        else:
            check_output(self.output, kind)
        if self.mesh and (kind != ".glb" or self.frame is not None or self.count is not None):
            raise UikaError("--mesh needs a .glb to write, and neither --frame nor --count")
        if kind == ".vrm" and self.motion is not None:
            raise UikaError(f"{self.output}: a VRM avatar has no motion of its own; leave --motion out")
        if not 16 <= self.texture <= _LARGEST:
            raise UikaError(f"--texture must lie between 16 and {_LARGEST}, not {self.texture}")
        if self.frame is not None and (self.motion is None or kind not in _POSED):
            raise UikaError(f"--frame needs --motion and one of {', '.join(_POSED)} to write")
        if self.motion is not None and self.frame is None and kind in _POSED and not self.mesh:
            raise UikaError(f"{self.output}: holds one pose; add --frame, or name a folder for all of the motion")
        if self.with_binding and (kind != ".ply" or self.motion is not None):
            raise UikaError("--with-binding needs a .ply to write and no --motion: such a file is canonical")
        if self.framing != "bust" and kind != ".html":
            raise UikaError("--framing only concerns .html pages")
        if self.axes == "y-up" and (kind not in _TURNED or self.with_binding):
            raise UikaError("--axes only concerns .ply and .splat files without --with-binding")

    def _write_mesh(self, kind: str, avatar: Avatar, head: HeadModel, motion: Motion | None) -> str:
        from uika import export

        if kind == ".obj":
            params = None if motion is None else motion.parameters(avatar.identity)[self.frame]
            beside = export.write_obj(self.output, avatar, head, params, self.texture)
            return f"{len(head.faces):,} triangles, with {', '.join(path.name for path in beside)}"
        if kind == ".vrm":
            mesh = export.write_vrm(self.output, avatar, head, self.output.stem, self.texture)
            return f"{len(head.faces):,} triangles, {len(mesh.morphs)} expressions, VRM 1.0"
        mesh = export.write_rigged_glb(self.output, avatar, head, motion, self.texture)
        played = "" if motion is None else f", {len(motion)} frames at {motion.fps:g} a second"
        size = self.output.stat().st_size / 1e6
        return f"{len(head.faces):,} triangles, {len(mesh.morphs)} morph targets, 5 joints{played}, {size:.1f} MB"

    def _write(self, kind: str, avatar: Avatar, head: HeadModel, motion: Motion | None) -> str:
        """Write and say what else there is to say."""
        from uika import export

        down = self.axes == "y-down"
        if kind == ".npz":
            export.write_npz(self.output, avatar, head, motion)
            return "" if motion is None else f", {len(motion)} frames"
        if kind == ".html" and motion is not None:
            size = export.write_html(self.output, avatar, motion, head, self.framing)
            return f", {len(motion)} frames, {size / 1e6:.1f} MB"
        if kind == "" and motion is not None:
            frames = export.write_ply_sequence(self.output, avatar, motion, head, y_down=down, progress=True)
            return f" in each of {frames} files"
        if self.with_binding:
            beside = export.write_bound_ply(self.output, avatar, head)
            return ", bound to triangles" + ("" if beside is None else f", and {beside}")
        params = None if motion is None else motion.parameters(avatar.identity)[self.frame]
        splats = export.posed_splats(avatar, head, params)
        if kind == ".glb":
            export.write_glb(self.output, splats, avatar.provenance)
            return ", Y up"
        if kind == ".spz":
            export.write_spz(self.output, splats)
            return ", Y up"
        turned = splats.half_turned() if down else splats
        if kind == ".splat":
            export.write_splat(self.output, turned)
        else:
            export.write_ply(self.output, turned, avatar.provenance)
        return f", Y {'down' if down else 'up'}"
