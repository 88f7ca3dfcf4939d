"""Synthetic people to look at, and how well their pictures agree: `python -m benchmarks.synthesis_quality`.

Writes `synthesis_people.jpg`, one picture of each of some people, and the warping errors of a few of them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks import figures
from benchmarks.harness import RESULTS, markdown, save
from uika.data import warping_errors
from uika.data.capture import Capture, open_capture
from uika.data.synthesis import Synthesis, synthesize
from uika.io.video import to_bytes

COLUMNS, PICTURE = 8, 128  # of the sheet: people in a row, pixels of each
SHEET_SEED, ERRORS_SEED = 5, 11
VIEWS, FRAMES = 9, 5
# Spatial and temporal errors that the paper's dataset table gives.
PUBLISHED = {
    "NeRSemble-v2 (paper)": (2.377e-2, 4.605e-4),
    "the paper's synthetic set": (4.252e-2, 7.868e-4),
    "CAP4D (paper)": (10.45e-2, 31.27e-4),
}
NOTE = (
    "Mean square difference of colours in [0,1] at the same place of the skin, between neighbouring views of a time "
    "step (spatial) and between successive time steps of a view (temporal).\n\n{}\n\n"
    "The numbers are not measured the same way, so the table does not rank the sets. The paper gives no more of its "
    "protocol than its name (pairs, resolution, masks, how pixels are matched). Ours use the renderer's exact "
    "correspondences, compare only places that both images show (512 x 512 cells of the atlas, mask above 0.99), pair "
    "views up to 45 degrees apart, and see no cloth and no strands of hair.\n\n"
    "`synthesis_people.jpg` shows {} people of another seed, each from another side."
)


def captures(settings: Synthesis) -> Iterator[Capture]:
    """The people of a set, made where they are missing."""
    synthesize(settings)
    for folder in sorted((settings.output / "captures").iterdir()):
        yield open_capture(folder)


def sheet(folder: Path, people: int) -> None:
    """Write one picture of each person; sides and moments go round."""
    settings = Synthesis(folder, people, VIEWS, 2, PICTURE, SHEET_SEED, archives=False)
    rows = -(-people // COLUMNS)
    whole = Image.new("RGB", (COLUMNS * PICTURE, rows * PICTURE), "white")
    for place, capture in enumerate(captures(settings)):
        picture = to_bytes(capture.sample(place * 5 % len(capture)).image.permute(1, 2, 0))
        whole.paste(Image.fromarray(picture), (place % COLUMNS * PICTURE, place // COLUMNS * PICTURE))
    whole.save(RESULTS / "synthesis_people.jpg", quality=90)


def errors(folder: Path, people: int, size: int) -> list[dict[str, object]]:
    """Warping errors: the mean over people, the lowest and the highest, and what others publish."""
    settings = Synthesis(folder, people, VIEWS, FRAMES, size, ERRORS_SEED, archives=False)
    found = [warping_errors(map(each.sample, range(len(each)))) for each in captures(settings)]
    values = np.array([(each.spatial, each.temporal) for each in found])
    name = f"ours: {people} people, {VIEWS} views, {FRAMES} frames, {size} x {size}"
    rows = {name: values.mean(0), "ours, lowest": values.min(0), "ours, highest": values.max(0), **PUBLISHED}
    return [
        {"data": name, "spatial": f"{spatial:.3g}", "temporal": f"{temporal:.3g}"}
        for name, (spatial, temporal) in rows.items()
    ]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sheet", type=int, default=32, help="people of the sheet")
    parser.add_argument("--people", type=int, default=6, help="people whose errors are measured")
    parser.add_argument("--size", type=int, default=256, help="pixels of the pictures that are compared")
    arguments = parser.parse_args(argv)
    RESULTS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        sheet(Path(name) / "sheet", arguments.sheet)
        rows = errors(Path(name) / "errors", arguments.people, arguments.size)
    save("synthesis_quality", "Synthetic people", NOTE.format(markdown(rows), arguments.sheet), {"rows": rows})
    panels = {
        kind: {kind: {str(row["data"]): float(str(row[kind])) for row in rows}} for kind in ("spatial", "temporal")
    }
    figures.bars("synthesis_quality", panels, "mean square difference", log=True)


if __name__ == "__main__":
    main()
