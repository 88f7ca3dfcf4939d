"""The authors' correspondence estimator out of its own file or the whole model's."""

from __future__ import annotations

from pathlib import Path

import torch

from uika.model.checkpoint import CheckpointError, listing
from uika.model.estimator import Estimator
from uika.model.precision import halve
from uika.model.released_file import ESTIMATOR, ESTIMATOR_FILE, compare, fill, read_shapes, unused_reason
from uika.model.released_sizes import SizeError, estimator_config


def load_estimator(path: str | Path, dtype: torch.dtype = torch.float32) -> Estimator:
    """Read the estimator from `fuvt_*.safetensors` (keys `fuvt.*`; the rest of that file is its teacher).

    Raises CheckpointError: the file is missing or damaged, or keys are missing, misshapen or unknown.
    """
    path = Path(path)
    shapes = read_shapes(path)
    prefix = ESTIMATOR_FILE if any(name.startswith(ESTIMATOR_FILE) for name in shapes) else ESTIMATOR
    try:
        with torch.device("meta"):
            model = Estimator(estimator_config(shapes, prefix))
    except SizeError as error:
        raise CheckpointError(f"{path}: {listing('missing or misshapen', error.names)}") from error
    if dtype == torch.bfloat16:
        halve(model, exempt=(model.uv_head,))
    names = {name.removeprefix(prefix): name for name in shapes if name.startswith(prefix)}
    expected = model.state_dict()
    unexpected = [old for new, old in names.items() if new not in expected and not unused_reason(old, "")]
    compare(path, {name: tuple(value.shape) for name, value in expected.items()}, shapes, names, unexpected)
    fill(model, path, {name: names[name] for name in expected}, expected)
    return model.eval()
