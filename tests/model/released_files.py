"""Files in the released format with random values, at any size."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from uika.model import PRESETS, BackboneConfig, Estimator, EstimatorConfig, ModelConfig, Reconstructor

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


def randomize(shapes: Mapping[str, tuple[int, ...]], seed: int = 0) -> dict[str, Tensor]:
    """Values of a size at which every layer takes part in the result."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, shape in shapes.items():
        noise = torch.randn(shape, generator=generator)
        if name.endswith("periods"):
            tensors[name] = 100.0 ** (torch.arange(shape[0]) / shape[0])
        elif name.endswith("bias_mask"):
            third = shape[0] // 3
            tensors[name] = torch.cat([torch.ones(third), torch.zeros(third), torch.ones(third)])
        elif name.endswith("gamma"):
            tensors[name] = 0.35 + 0.15 * noise
        elif name.endswith("bias") or "token" in name or "pos_embed" in name:
            tensors[name] = 0.1 * noise
        elif len(shape) == 1:
            tensors[name] = 1 + 0.2 * noise
        else:
            tensors[name] = noise / math.sqrt(math.prod(shape[1:]))
    return tensors


def released_tensors(config: ModelConfig = SMALL, estimator: EstimatorConfig = SMALL_ESTIMATOR) -> dict[str, Tensor]:
    """What `uika.safetensors` would hold at this size, keys that change nothing included."""
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
    return randomize(shapes) | head_tables(config.map_size)


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
