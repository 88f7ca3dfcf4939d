"""The command `uika synthesize`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

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
    archives: bool = True
    """Whether to write webdataset shards beside the folders."""

    def run(self) -> int:
        """Make what is missing."""
        from uika.data import Synthesis, synthesize

        fields = ("output", "identities", "views", "frames", "size", "seed", "shard", "archives")
        report = synthesize(Synthesis(**{name: getattr(self, name) for name in fields}))
        print(f"{self.output}: {report.made} people made, {report.kept} were complete, {report.images} new images")
        return 0
