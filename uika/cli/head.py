"""The command `uika head`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg, subcommand

from uika.io.files import check_output

if TYPE_CHECKING:
    from uika.head import HeadModel


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
    bust: bool = True
    """Continue the head by neck, shoulders and chest of the built-in one."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("flame.npz")
    """The head file to write; use it with --head or UIKA_HEAD."""

    def run(self) -> int:
        """Read, embed landmarks, save."""
        target = check_output(self.output, ".npz")
        from uika.head_import import import_flame
        from uika.io.progress import steps

        with steps() as say:
            head = import_flame(self.model, target, self.obj, self.masks, self.eyelids, say, bust=self.bust)
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


def _summary(head: HeadModel) -> str:
    return (
        f"head model '{head.id}', {len(head.template):,} vertices, {len(head.faces):,} triangles, "
        f"{len(head.identity_basis)} identity modes, {len(head.expression_names)} expressions, "
        f"{len(head.landmark_ids)} landmarks"
    )
