"""The command `uika study`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from uika.errors import UikaError


@dataclass(frozen=True)
class Study:
    """Ask people which system's clips are better: a blinded questionnaire, and the table of its answers.

    Example: uika study clips -o study
    """

    clips: Positional[Path | None] = None
    """A folder with one folder of clips for each system, SYSTEM/CLIP.mp4; `reference` is shown, not rated."""
    answers: tuple[Path, ...] = ()
    """Filled questionnaires (.csv), to make the table of."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("study")
    """The study's folder, with the page, the key to it and the table."""
    seed: int = 0
    """Of the names under which clips are shown."""

    def run(self) -> int:
        """Write the page, or the table."""
        if self.clips is None and not self.answers:
            raise UikaError("give the folder of clips, or filled questionnaires with --answers")
        from uika.evaluate.study import KEY, read_answers, write_study, write_table

        if self.clips is not None:
            page, key = write_study(self.clips, self.output, self.seed)
            print(f"wrote {page}: open it in any browser, it needs no network; each participant saves a .csv")
            print(f"wrote {key}: tells which system made which clip; keep it from the participants")
        if self.answers:
            table = write_table(read_answers(self.answers, self.output / KEY), self.output)
            print(f"{table.read_text(encoding='utf-8')}wrote {table}")
        return 0
