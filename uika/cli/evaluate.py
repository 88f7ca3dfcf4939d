"""The command `uika evaluate`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from uika.cli.study import Study
from uika.errors import UikaError


@dataclass(frozen=True)
class Evaluate:
    """Score avatars against held-out frames, in the paper's settings.

    Run it again to go on. Example: uika evaluate --data people -o report
    """

    data: Annotated[Path | None, arg(metavar="PATH")] = None
    """A folder with captures or shards."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("report")
    """The report's folder, which gathers all runs."""
    setting: Literal["mono", "multi", "both"] = "mono"
    """Frames of one camera, or of several."""
    task: Literal["self", "cross", "both"] = "self"
    """Whether the person's own held-out frames drive the head, or those of another person."""
    views: str = "1,2,4,8,16"
    """Numbers of source frames, with commas."""
    model: str = "tiny"
    """tiny, none, or a trained or released file."""
    estimator: Annotated[Path | None, arg(metavar="PATH")] = None
    """Correspondence estimator for the sources."""
    backbone: Annotated[Path | None, arg(metavar="PATH")] = None
    """DINOv3 weights for a model without."""
    name: str = ""
    """The method's name in the tables; the model's or folder's name if left out."""
    correspondence: Literal["fit", "exact"] = "fit"
    """Sources as pictures alone, or with their true heads and cameras."""
    size: int = 512
    """Side of the compared pictures in pixels."""
    background: float = 1.0
    """Grey level behind the person, 0 to 1."""
    targets: int = 8
    """Target frames of each sequence, at most."""
    lpips: Annotated[Path | None, arg(metavar="PATH")] = None
    """LPIPS weights (.safetensors)."""
    arcface: Annotated[Path | None, arg(metavar="PATH")] = None
    """An ArcFace network (.onnx) for CSIM."""
    external: Annotated[Path | None, arg(metavar="PATH")] = None
    """Score another system's pictures in this folder, SEQUENCE/VIEWS/TARGET.png, instead of a model's."""
    study: Annotated[Path | None, arg(metavar="PATH")] = None
    """Clips to ask people about instead, see uika study."""

    def run(self) -> int:
        """Evaluate, write the report and print the table."""
        if self.study is not None:
            return Study(self.study, output=self.output).run()
        if self.data is None:
            raise UikaError("give the data with --data, or clips to ask people about with --study")
        counts = _counts(self.views)
        from uika.evaluate import Evaluation, evaluate_all, gather, write_report
        from uika.evaluate.report import markdown_table

        if self.external is None:
            from uika.avatar.rendering import check_renderer
            from uika.reconstruction import check_model

            check_model(self.model, self.estimator, self.backbone)
            check_renderer()
        given = {field.name: getattr(self, field.name) for field in fields(Evaluation)} | {"views": counts}
        settings = ("mono", "multi") if self.setting == "both" else (self.setting,)
        tasks = ("self", "cross") if self.task == "both" else (self.task,)
        wanted = [Evaluation(**given | {"setting": s, "task": t}) for s in settings for t in tasks]
        outcomes = evaluate_all(wanted, progress=True)
        written = write_report(self.output)
        for section in gather(self.output):
            if section.setting in settings and section.task in tasks:
                print("\n".join([section.title, *markdown_table(section)]))
        lines = dict.fromkeys(line for outcome in outcomes for line in outcome.protocol.sentences())
        print("\n".join(f"- {line}" for line in lines))
        for sentence in dict.fromkeys(sentence for outcome in outcomes for sentence in outcome.missing):
            print(f"left out: {sentence}")
        made, kept = (sum(getattr(outcome, name) for outcome in outcomes) for name in ("made", "kept"))
        print(f"{made} results made, {kept} were complete")
        for path in written:
            print(f"wrote {path}")
        return 0


def _counts(text: str) -> tuple[int, ...]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise UikaError(f"--views must be whole numbers with commas, such as 1,2,4, not '{text}'")
    return tuple(int(part) for part in parts)
