"""The command `uika synthesize`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg


@dataclass(frozen=True)
class Synthesize:
    """Make training data: people who do not exist, seen from many sides, with exact labels.

    Run the same command again to go on after an interruption. Example: uika synthesize -o people --identities 100
    """

    output: Annotated[Path, arg(aliases=["-o"])]
    """The folder to write."""
    identities: int = 1000
    """Number of people."""
    views: int = 9
    """Cameras around each of them."""
    frames: int = 13
    """Moments of each performance."""
    size: int = 512
    """Side of the images in pixels."""
    seed: int = 0
    """Decides who the people are."""
    shard: str = "0/1"
    """i/n makes every n-th person from the i-th on, to share the work among machines."""
    captures: bool = True
    """Whether to write a folder of loose files for each person."""
    archives: bool = True
    """Whether to write a webdataset shard for each person."""
    labels: Literal["full", "tracked"] = "full"
    """tracked leaves correspondences and depths out; training then makes them from the head's parameters."""
    images: Literal["png", "jpeg"] = "png"
    """jpeg takes a third of png's bytes."""

    def run(self) -> int:
        """Make what is missing."""
        from uika.data import Synthesis, synthesize

        report = synthesize(Synthesis(**{field.name: getattr(self, field.name) for field in fields(Synthesis)}))
        print(f"{self.output}: {report.made} people made, {report.kept} were complete, {report.images} new images")
        return 0
