"""Files in the released format with random values, at any size."""

import dataclasses
import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from uika.model import (
    ESTIMATORS,
    PRESETS,
    BackboneConfig,
    Estimator,
    EstimatorConfig,
    ModelConfig,
    Reconstructor,
)

SMALL = dataclasses.replace(
    PRESETS["paper"],
    map_size=32,
    token_grid=8,
    backbone=BackboneConfig(dim=32, depth=6, heads=2, taps=(0, 2, 3, 5), frozen=True),
    dim=32,
    heads=2,
    layers=4,
    outputs=(1, 2, 3, 4),
    dpt_projections=(8, 12, 16, 16),
    dpt_features=16,
    mlp_width=24,
)
SMALL_ESTIMATOR = EstimatorConfig(
    backbone=BackboneConfig(dim=32, depth=2, heads=2, taps=(1,)), heads=2, channels=(8, 12, 16, 16), features=16
)
VALID = 133541  # texels of the released atlas
# Tables of the released head: name, type in the file, shape.
FULL_TABLES: dict[str, tuple[str, tuple[int, ...]]] = {
    "v_template": ("F32", (5023, 3)),
    "shapedirs": ("F32", (5023, 3, 400)),
    "posedirs": ("F32", (36, 15069)),
    "J_regressor": ("F32", (5, 5023)),
    "parents": ("I64", (5,)),
    "lbs_weights": ("F32", (5023, 5)),
    "full_lmk_faces_idx": ("I64", (1, 70)),
    "full_lmk_bary_coords": ("F32", (1, 70, 3)),
    "neck_kin_chain": ("I64", (2,)),
    "valid_mask_flatten": ("BOOL", (384 * 384,)),
    "pix_to_v_idx_flatten": ("I64", (VALID, 3)),
    "pix_bary_flatten": ("F32", (VALID, 3)),
    "uv_color_flatten": ("F32", (VALID, 3)),
    "v_template_pix": ("F32", (VALID, 3)),
    "lbs_weights_pix": ("F32", (VALID, 5)),
    "J_regressor_pix": ("F32", (5, VALID)),
    "posedirs_pix": ("F32", (36, 3 * VALID)),
    "shapedirs_pix": ("F32", (VALID, 3, 400)),
}


def randomize(shapes: Mapping[str, tuple[int, ...]], seed: int = 0) -> dict[str, Tensor]:
    """Values of a size at which every layer takes part in the result."""
    generator = torch.Generator().manual_seed(seed)
    return {name: shaped(name, torch.randn(shape, generator=generator)) for name, shape in shapes.items()}


def shaped(name: str, noise: Tensor) -> Tensor:
    """Unit noise scaled as the weight of this name."""
    shape = noise.shape
    if name.endswith("periods"):
        return 100.0 ** (torch.arange(shape[0]) / shape[0])
    if name.endswith("bias_mask"):
        third = shape[0] // 3
        return torch.cat([torch.ones(third), torch.zeros(third), torch.ones(third)])
    if name.endswith("gamma"):
        return 0.35 + 0.15 * noise
    if name.endswith("bias") or "token" in name or "pos_embed" in name:
        return 0.1 * noise
    return 1 + 0.2 * noise if len(shape) == 1 else noise / math.sqrt(math.prod(shape[1:]))


def released_shapes(config: ModelConfig, estimator: EstimatorConfig) -> dict[str, tuple[int, ...]]:
    """Weights of `uika.safetensors` at this size, those that change nothing included."""
    with torch.device("meta"):
        network, locator = Reconstructor(config), Estimator(estimator)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    shapes |= {f"uv_wrapper.model.{name}": tuple(value.shape) for name, value in locator.state_dict().items()}
    last = f"transformer.layers.{config.layers - 1}."
    for attention in ("attn", "attn2"):
        shapes[f"{last}{attention}.add_q_proj.weight"] = (config.dim, config.dim)
        shapes[f"{last}{attention}.add_q_proj.bias"] = (config.dim,)
        shapes[f"{last}{attention}.norm_added_q.weight"] = (config.dim // config.heads,)
    shapes["encoder.model.mask_token"] = (1, config.backbone.dim)
    shapes["uv_wrapper.model.aggregator.patch_embed.mask_token"] = (1, estimator.backbone.dim)
    return shapes


def released_tensors(config: ModelConfig = SMALL, estimator: EstimatorConfig = SMALL_ESTIMATOR) -> dict[str, Tensor]:
    """What `uika.safetensors` would hold at this size."""
    return randomize(released_shapes(config, estimator)) | head_tables(config.map_size)


def head_tables(map_size: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(9)
    axis = torch.arange(map_size) + 0.5 - map_size / 2
    valid = ((axis[:, None] ** 2 + axis**2).sqrt() < 0.45 * map_size).flatten()
    count = int(valid.sum())
    tables = {
        "valid_mask_flatten": valid,
        "v_template_pix": 0.2 * torch.rand(count, 3, generator=generator) - 0.1,
        "pix_to_v_idx_flatten": torch.randint(0, 50, (count, 3), generator=generator),
        "pix_bary_flatten": torch.rand(count, 3, generator=generator).softmax(dim=1),
        "shapedirs_pix": torch.rand(count, 3, 4, generator=generator),
        "v_template": torch.rand(50, 3, generator=generator),
        "neck_kin_chain": torch.tensor([1, 0]),
    }
    return {f"renderer.flame_model.{name}": value for name, value in tables.items()}


def write(folder: Path, tensors: Mapping[str, Tensor], name: str = "uika.safetensors") -> Path:
    path = folder / name
    save_file({key: value.contiguous() for key, value in tensors.items()}, path)
    return path


def write_full(path: Path, tables: Mapping[str, Tensor] | None = None) -> None:
    """The released file at its full size, 4.5 GiB, tensor by tensor; `tables` take the place of random ones."""
    kinds = {name: ("F32", shape) for name, shape in released_shapes(PRESETS["paper"], ESTIMATORS["paper"]).items()}
    types = {torch.float32: "F32", torch.int64: "I64", torch.bool: "BOOL"}
    if tables is None:
        kinds |= {f"renderer.flame_model.{name}": entry for name, entry in FULL_TABLES.items()}
    else:
        kinds |= {name: (types[value.dtype], tuple(value.shape)) for name, value in tables.items()}
    width = {"F32": 4, "I64": 8, "BOOL": 1}
    header, place = {}, 0
    for name, (kind, shape) in kinds.items():
        end = place + width[kind] * math.prod(shape)
        header[name] = {"dtype": kind, "shape": list(shape), "data_offsets": [place, end]}
        place = end
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    block = torch.randn(1 << 22, generator=torch.Generator().manual_seed(0))
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name, (kind, shape) in kinds.items():
            count = math.prod(shape)
            if tables is not None and name in tables:
                value = tables[name]
            elif kind == "F32":
                noise = block.repeat(-(-count // len(block)))[:count].view(shape)
                value = 0.1 * noise if name.startswith("renderer.") else shaped(name, noise)
            elif kind == "BOOL":
                value = torch.arange(count) < VALID
            else:
                value = torch.arange(count) % 5000
            file.write(value.contiguous().numpy().data)
