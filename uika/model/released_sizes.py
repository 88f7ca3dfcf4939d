"""The configuration of a released model, read from the shapes in its file."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping

from uika.model.config import PRESETS, BackboneConfig, EstimatorConfig, ModelConfig

Shapes = Mapping[str, tuple[int, ...]]

# Depths of the backbone that the released encoder reads; other depths take evenly spaced ones.
_TAPS = {24: (4, 11, 17, 23), 12: (2, 5, 8, 11)}


class SizeError(ValueError):
    """Shapes from which no size can be read; `names` lists the keys at fault."""

    def __init__(self, names: list[str]) -> None:
        """The keys that are missing or make no sense."""
        super().__init__(", ".join(names))
        self.names = names


def model_config(shapes: Shapes, map_size: int | None) -> ModelConfig:
    """Sizes of `encoder`, `transformer` and `gs_decoder`; `map_size` None takes four texels per token.

    Raises SizeError when a key that tells a size is missing or senseless.
    """
    needed = [
        "transformer.uv_token",
        "transformer.layers.0.attn.norm_q.weight",
        *(f"gs_decoder.dpt_decoder.projects.{level}.weight" for level in range(4)),
        "gs_decoder.dpt_decoder.output_conv.0.weight",
        "gs_decoder.mlp_net.layers.0.weight",
    ]
    _require(shapes, needed)
    tokens, dim = shapes["transformer.uv_token"]
    grid, layers = math.isqrt(tokens), _count(shapes, r"transformer\.layers\.(\d+)\.")
    taps = _count(shapes, r"encoder\.fusion_head\.projects\.(\d+)\.")
    outputs = _count(shapes, r"transformer\.norm_list\.(\d+)\.")
    if grid * grid != tokens or outputs != 4 or layers < outputs:
        raise SizeError(["transformer.uv_token", "transformer.layers", "transformer.norm_list"])
    return dataclasses.replace(
        PRESETS["paper"],
        name="released",
        image_size=0,
        map_size=4 * grid if map_size is None else map_size,
        token_grid=grid,
        backbone=_backbone(shapes, "encoder.model.", taps),
        dim=dim,
        heads=dim // shapes["transformer.layers.0.attn.norm_q.weight"][0],
        layers=layers,
        outputs=_spaced(layers, 4),  # type: ignore[arg-type]
        dpt_projections=_channels(shapes, "gs_decoder.dpt_decoder."),
        dpt_features=shapes["gs_decoder.dpt_decoder.output_conv.0.weight"][0],
        mlp_width=shapes["gs_decoder.mlp_net.layers.0.weight"][0],
    )


def estimator_config(shapes: Shapes, prefix: str) -> EstimatorConfig:
    """Sizes of the estimator whose keys start with `prefix`. Raises SizeError as `model_config`."""
    norm, head = f"{prefix}aggregator.frame_blocks.0.attn.q_norm.weight", f"{prefix}uv_head."
    needed = [norm, f"{head}scratch.output_conv1.weight", *(f"{head}projects.{level}.weight" for level in range(4))]
    _require(shapes, needed)
    backbone = _backbone(shapes, f"{prefix}aggregator.patch_embed.", 1)
    layers = _count(shapes, re.escape(prefix) + r"aggregator\.frame_blocks\.(\d+)\.")
    if layers != 4:
        raise SizeError([f"{prefix}aggregator.frame_blocks"])
    return EstimatorConfig(
        backbone=backbone,
        heads=backbone.dim // shapes[norm][0],
        channels=_channels(shapes, head),
        features=shapes[f"{head}scratch.output_conv1.weight"][1],
        layers=layers,
    )


def _backbone(shapes: Shapes, prefix: str, taps: int) -> BackboneConfig:
    names = [f"{prefix}{name}" for name in ("storage_tokens", "patch_embed.proj.weight", "rope_embed.periods")]
    _require(shapes, names)
    depth = _count(shapes, re.escape(prefix) + r"blocks\.(\d+)\.")
    storage, patch, periods = (shapes[name] for name in names)
    if not 1 <= taps <= depth or storage[2] % (4 * periods[0]):
        raise SizeError([*names, f"{prefix}blocks"])
    chosen = _TAPS.get(depth, ()) if taps == 4 else ()
    return BackboneConfig(
        dim=storage[2],
        depth=depth,
        heads=storage[2] // (4 * periods[0]),
        taps=chosen or tuple(block - 1 for block in _spaced(depth, taps)),
        patch_size=patch[3],
        storage_tokens=storage[1],
        frozen=True,
    )


def _spaced(depth: int, count: int) -> tuple[int, ...]:
    """`count` evenly spaced 1-based depths, the last of them `depth`."""
    return tuple((index + 1) * depth // count for index in range(count))


def _channels(shapes: Shapes, prefix: str) -> tuple[int, int, int, int]:
    first, second, third, fourth = (shapes[f"{prefix}projects.{level}.weight"][0] for level in range(4))
    return first, second, third, fourth


def _count(shapes: Shapes, pattern: str) -> int:
    numbers = {int(found.group(1)) for name in shapes if (found := re.match(pattern, name))}
    return max(numbers) + 1 if numbers else 0


def _require(shapes: Shapes, names: list[str]) -> None:
    dimensions = {"uv_token": 2, "storage_tokens": 3, "patch_embed.proj.weight": 4}
    ranks = {name: next((rank for end, rank in dimensions.items() if name.endswith(end)), 1) for name in names}
    bad = [name for name in names if len(shapes.get(name, ())) < ranks[name] or 0 in shapes[name]]
    if bad:
        raise SizeError(bad)
