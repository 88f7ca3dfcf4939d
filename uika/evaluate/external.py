"""Pictures that another system made of the same targets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.errors import UikaError


def external_file(folder: Path, sequence: str, views: int, target: str) -> Path:
    """Where a system's picture of a target lies: FOLDER/SEQUENCE/VIEWS/TARGET.png, views with two digits."""
    return folder / sequence / f"{views:02d}" / f"{target}.png"


def check_external(folder: Path, jobs: Sequence[tuple[str, int, Sequence[str]]]) -> None:
    """Make sure that all pictures are there before the work starts.

    Args:
        folder: the system's.
        jobs: sequence, number of views and target names of everything to score.

    Raises:
        UikaError: some are missing; the message names the first and says how many.
    """
    files = [external_file(folder, name, views, target) for name, views, targets in jobs for target in targets]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise UikaError(
            f"{missing[0]}: is missing, and so are {len(missing) - 1} more of {len(files)} frames to score; "
            "they belong at DIR/SEQUENCE/VIEWS/TARGET.png (see docs/evaluation.md)"
        )


def external_picture(folder: Path, sequence: str, views: int, target: str, size: int) -> Tensor:
    """Read one picture [S,S,3].

    Raises:
        UikaError: it cannot be read or has another size.
    """
    from PIL import Image

    file = external_file(folder, sequence, views, target)
    try:
        with Image.open(file) as image:
            pixels = np.asarray(image.convert("RGB"))
    except Exception as error:  # decoders meet hostile bytes with many exception types
        raise UikaError(f"{file}: cannot be read as a picture ({error})") from error
    if pixels.shape[:2] != (size, size):
        raise UikaError(f"{file}: has {pixels.shape[1]}x{pixels.shape[0]} pixels, not {size}x{size} as --size says")
    return torch.from_numpy(pixels.astype(np.float32) / 255)
