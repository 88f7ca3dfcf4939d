"""The command `uika bench`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from uika.errors import UikaError
from uika.io.files import check_folder, replacing


@dataclass(frozen=True)
class Bench:
    """Time the network at several numbers of photos, with its memory and errors.

    Example: uika bench model --views 1 4 16
    """

    what: Positional[Literal["model"]]
    """What to measure."""
    preset: Literal["tiny", "base", "paper"] = "tiny"
    """Size of the network; its weights are random."""
    views: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """Numbers of photos."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("out/model_latency")
    """The folder for the table; a second call goes on with the rows it keeps there."""

    def run(self) -> int:
        """Measure, print the table and write it."""
        folder = check_folder(self.output)
        if not self.views or min(self.views) < 1:
            raise UikaError("--views must be whole numbers from 1, such as 1 4 16")
        from uika.evaluate.latency import in_order, measure_network, table

        rows = []
        for row in measure_network(self.preset, self.views, kept=folder / self.preset):
            rows.append(row)
            print(table([row]).splitlines()[-1], flush=True)
        text = f"`{self.preset}` with random weights; stages in processor seconds.\n\n{table(in_order(rows))}\n"
        target = folder / "model_latency.md"
        with replacing(target) as temporary:
            temporary.write_text(text)
        print(f"wrote {target}")
        return 0
