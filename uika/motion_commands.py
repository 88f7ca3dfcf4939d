"""The commands around heads and motions; each dataclass is one command's arguments."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg, subcommand

from uika.io.files import check_output

if TYPE_CHECKING:
    from uika.head import HeadModel
    from uika.tracking import Track as Tracked


@dataclass(frozen=True)
class ImportHead:
    """Convert a FLAME model file; nothing in it is executed.

    Example: uika head import flame2023.pkl --obj head_template.obj -o flame.npz
    """

    model: Positional[Path]
    """FLAME 2020, 2023 or 2023 Open: the public pickle, or an .npz with the same arrays."""
    obj: Path | None = None
    """Wavefront file of the mesh with texture coordinates, which the pickle lacks."""
    masks: Path | None = None
    """FLAME's masks file; without it the regions are found from the geometry."""
    eyelids: tuple[Path, ...] = ()
    """Two .npy files that shut the left and the right lid."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("flame.npz")
    """The head file to write; use it with --head or UIKA_HEAD."""

    def run(self) -> int:
        """Read, embed landmarks, save."""
        target = check_output(self.output, ".npz")
        from uika.head_import import import_flame

        head = import_flame(self.model, target, self.obj, self.masks, self.eyelids)
        print(f"wrote {target}: {_summary(head)}")
        return 0


@dataclass(frozen=True)
class ShowHead:
    """Say which head model is in use, or in a file.

    Example: uika head show flame.npz
    """

    path: Positional[Path | None] = None
    """A head file; without it, the one that would be used."""

    def run(self) -> int:
        """Print the counts."""
        from uika.head import load_head

        print(_summary(load_head(self.path)))
        return 0


@dataclass(frozen=True)
class Head:
    """Import a FLAME model, or show what a head model holds.

    Example: uika head import flame2023.pkl --obj head_template.obj -o flame.npz
    """

    action: Annotated[ImportHead, subcommand("import")] | Annotated[ShowHead, subcommand("show")]

    def run(self) -> int:
        """Run the chosen action."""
        return self.action.run()


@dataclass(frozen=True)
class Track:
    """Find how the head in a video moves.

    Example: uika track me.mp4 -o motion.npz --preview preview.mp4
    """

    video: Positional[Path]
    """A video with one face."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("motion.npz")
    """The motion file to write: .npz, or .csv and .json with ARKit activations."""
    preview: Path | None = None
    """A video to write that shows frames and tracked head side by side."""

    def run(self) -> int:
        """Track and save."""
        target = check_output(self.output, self.output.suffix if self.output.suffix in (".csv", ".json") else ".npz")
        picture = None if self.preview is None else check_output(self.preview, ".mp4")
        from uika.head import load_head
        from uika.motion import save_motion, write_csv, write_json
        from uika.tracking import track_video, write_preview

        head = load_head()
        found = track_video(self.video, head, progress=True)
        if target.suffix == ".npz":
            save_motion(found.motion, target, head)
        else:
            write = write_csv if target.suffix == ".csv" else write_json
            write(found.motion, target, head.expression_names)
        if picture is not None:
            write_preview(found, self.video, picture, head, progress=True)
        print(f"wrote {target}: {describe(found)}")
        return 0


def describe(found: Tracked) -> str:
    """One sentence on a tracked video."""
    count, seconds = len(found.poses), sum(found.seconds.values())
    text = f"{count} frames in {seconds:.1f} s ({count / seconds:.0f} frames/s), {found.motion.fps:g} frames per second"
    if found.lost:
        text += f"; no face in {len(found.lost)} frames, filled in: {_spans(found.lost)}"
    return text


def _spans(indices: tuple[int, ...]) -> str:
    """Frame numbers as ranges, the first few of them."""
    spans: list[list[int]] = []
    for index in indices:
        if spans and index == spans[-1][1] + 1:
            spans[-1][1] = index
        else:
            spans.append([index, index])
    shown = [str(a) if a == b else f"{a}-{b}" for a, b in spans[:8]]
    return ", ".join(shown) + (" ..." if len(spans) > 8 else "")


def _summary(head: HeadModel) -> str:
    return (
        f"head model '{head.id}', {len(head.template):,} vertices, {len(head.faces):,} triangles, "
        f"{len(head.identity_basis)} identity modes, {len(head.expression_names)} expressions, "
        f"{len(head.landmark_ids)} landmarks"
    )
