"""Files of correspondence estimators: those that a training here writes, and the released ones."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from uika.head import HeadModel
from uika.io.files import write_tensors
from uika.model import released_estimator
from uika.model.checkpoint import CheckpointError, check_depth
from uika.model.config import BackboneConfig, EstimatorConfig, SurfaceEstimatorConfig
from uika.model.estimator import Estimator
from uika.model.surface_codes import CODE, SurfaceTable
from uika.model.surface_estimator import SurfaceEstimator
from uika.model.weight_kind import ESTIMATOR_FORMAT, ESTIMATORS, check_kind

AnyEstimator = Estimator | SurfaceEstimator
_VERSION = "1"
_FLAME_VERTICES = 5023
_EXACT = ("periods", "bias_mask", "table_code", "table_uv", "table_slope")  # rounding would turn angles, shift places


def read_estimator(path: str | Path) -> AnyEstimator:
    """Read an estimator from a file of this program or of the release; float32 on the CPU, in eval mode.

    The released model file holds an estimator as well, which is then read out of it.

    Raises:
        CheckpointError: the file is missing, damaged or holds no estimator.
    """
    if check_kind(path, ESTIMATORS) == "estimator":
        return load_estimator(path)
    return released_estimator.load_estimator(path)


def check_estimator_head(path: str | Path, head: HeadModel) -> None:
    """Refuse an estimator whose UV coordinates are those of another head model.

    Raises:
        CheckpointError: the sentence says which head model it was trained for.
    """
    head = head.without_bust
    if check_kind(path, ESTIMATORS) != "estimator":
        if len(head.template) != _FLAME_VERTICES:
            raise CheckpointError(
                f"{path}: finds the texture coordinates of FLAME, not those of the head model '{head.id}'; "
                "choose a FLAME head with --head"
            )
        return
    with safe_open(path, framework="pt") as file:
        trained = json.loads((file.metadata() or {}).get("provenance", "{}")).get("head", head.id)
    if trained != head.id:
        raise CheckpointError(
            f"{path}: was trained for the head model '{trained}', but '{head.id}' is in use; --head chooses"
        )


def load_estimator(path: str | Path) -> AnyEstimator:
    """Read an estimator that a training wrote; weights are float32 on the CPU, the model is in eval mode.

    Raises:
        CheckpointError: the file is missing, damaged or of another kind.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != ESTIMATOR_FORMAT or header.get("version") != _VERSION:
                raise CheckpointError(f"{path}: not a {ESTIMATOR_FORMAT} file of version {_VERSION}")
            config = json.loads(header["config"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            tensors = {name: value.float() if value.is_floating_point() else value for name, value in tensors.items()}
            with torch.device("meta"):
                model = _surface(path, config, tensors) if "widths" in config else _views(path, config, tensors)
            model.load_state_dict(tensors, assign=True)
    except CheckpointError:
        raise
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: cannot be read as an estimator ({error})") from error
    return model.eval()


def save_estimator(
    path: Path,
    config: EstimatorConfig | SurfaceEstimatorConfig,
    state: Mapping[str, Tensor],
    provenance: Mapping[str, str],
) -> None:
    """Write weights and config; the file appears under its name only when it is complete.

    Weights are kept in half precision: float16 for the small estimator, bfloat16 for those of the paper's kind.
    """
    header = {
        "format": ESTIMATOR_FORMAT,
        "version": _VERSION,
        "config": json.dumps(dataclasses.asdict(config)),
        "provenance": json.dumps(dict(provenance)),
    }
    half = torch.bfloat16 if isinstance(config, EstimatorConfig) else torch.float16
    tensors = {
        name: (value.to(half) if value.is_floating_point() and not name.endswith(_EXACT) else value).contiguous()
        for name, value in state.items()
    }
    write_tensors(path, tensors, header)


def _views(path: str | Path, config: dict[str, Any], tensors: Mapping[str, Tensor]) -> Estimator:
    """An estimator of the paper's kind without weights."""
    backbone = BackboneConfig(**_tuples(config.pop("backbone")))
    check_depth(path, backbone.depth + config.get("layers", 0), len(tensors))
    return Estimator(EstimatorConfig(backbone=backbone, **_tuples(config)))


def _surface(path: str | Path, config: dict[str, Any], tensors: Mapping[str, Tensor]) -> SurfaceEstimator:
    """A small estimator without weights, whose table is as long as the file's."""
    values = SurfaceEstimatorConfig(**_tuples(config))
    check_depth(path, sum(values.blocks) + 2 * len(values.widths), len(tensors))
    points = len(tensors["table_code"])
    table = SurfaceTable(torch.empty(points, CODE), torch.empty(points, 2), torch.empty(points, 2, CODE))
    return SurfaceEstimator(values, table)


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
