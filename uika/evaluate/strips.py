"""Pictures of the report: input, result, truth and error side by side."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from uika.io.video import write_png
from uika.metrics import flip_map

MOST = 256  # pixels of a cell
_RAMP = (  # error from 0 to 1, readable in grey and by the colour-blind
    (0.00, 0.00, 0.02),
    (0.32, 0.07, 0.48),
    (0.72, 0.22, 0.47),
    (0.99, 0.53, 0.38),
    (0.99, 0.99, 0.75),
)


def titles(task: str) -> tuple[str, ...]:
    """What the cells of a strip show."""
    return ("input", "ours", "truth", "FLIP error") if task == "self" else ("input", "ours", "driver")


def write_strip(path: Path, source: Tensor, result: Tensor, truth: Tensor, task: str) -> None:
    """Write the cells of `titles` beside each other; all pictures [S,S,3] in [0,1]."""
    cells = [source, result, truth]
    if task == "self":
        cells.append(error_picture(flip_map(result, truth).float()))
    write_png(path, torch.cat([_cell(each) for each in cells], 1))


def error_picture(error: Tensor) -> Tensor:
    """Errors [H,W] in [0,1] as colours [H,W,3], from black over purple and orange to pale yellow."""
    ramp = error.new_tensor(_RAMP)
    place = error.clamp(0, 1) * (len(ramp) - 1)
    below = place.long().clamp(max=len(ramp) - 2)
    return torch.lerp(ramp[below], ramp[below + 1], (place - below)[..., None])


def _cell(picture: Tensor) -> Tensor:
    if len(picture) <= MOST:
        return picture
    planes = picture.permute(2, 0, 1)[None]
    return functional.interpolate(planes, (MOST, MOST), mode="bilinear", antialias=True)[0].permute(1, 2, 0)
