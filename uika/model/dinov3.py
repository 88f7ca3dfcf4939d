"""DINOv3 weights from local files, in the key formats of Hugging Face and of Meta, for a `VisionTransformer`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from uika.model.backbone import VisionTransformer
from uika.model.checkpoint import CheckpointError, misfits
from uika.model.config import BackboneConfig

_T = TypeVar("_T")

# Hugging Face's names on the left, ours (Meta's) on the right.
_NAMES = {
    "embeddings.cls_token": "cls_token",
    "embeddings.register_tokens": "storage_tokens",
    "embeddings.mask_token": "mask_token",
    "embeddings.patch_embeddings.": "patch_embed.proj.",
}
_PARTS = {
    "attention.o_proj": "attn.proj",
    "layer_scale1.lambda1": "ls1.gamma",
    "layer_scale2.lambda1": "ls2.gamma",
    "mlp.up_proj": "mlp.fc1",
    "mlp.down_proj": "mlp.fc2",
}
_QUERY_KEY_VALUE = re.compile(r"(.*)attention\.([qkv])_proj\.(weight|bias)")
_PATCHES = ("patch_embed.proj.weight", "embeddings.patch_embeddings.weight")
# Blocks, channels and patches of the published backbones that presets are made for.
KNOWN = {
    (12, 384, 16): "DINOv3 ViT-S/16",
    (12, 768, 16): "DINOv3 ViT-B/16",
    (24, 1024, 16): "DINOv3 ViT-L/16",
}
_CONVERT = (
    "python -c 'import sys, torch, safetensors.torch as s; t = torch.load(sys.argv[1], weights_only=True); "
    "s.save_file({k: v.contiguous() for k, v in t.items()}, sys.argv[2])'"
)


def load_backbone(model: VisionTransformer, path: str | Path) -> None:
    """Fill a backbone (`Reconstructor.encoder.model`, say) with the weights of a DINOv3 safetensors file.

    Raises:
        CheckpointError: the file is missing, damaged or a pickle, or its keys do not fit the model; it lists them.
    """
    path = Path(path)
    tensors = read_backbone(path)
    expected = model.state_dict()
    for name, value in expected.items():
        # Hugging Face computes the periods and leaves out the keys' bias, which is switched off.
        if name.endswith(("periods", "bias_mask")) and name not in tensors:
            tensors[name] = value
    if problems := misfits(tensors, expected, unused=("mask_token",)):
        raise CheckpointError(f"{path}: does not fit this backbone: {problems}")
    model.load_state_dict({name: tensors[name].float() for name in expected}, assign=True)


def read_backbone(path: str | Path) -> dict[str, Tensor]:
    """The tensors of a DINOv3 file under Meta's names, whichever of the two formats it has.

    Raises:
        CheckpointError: the file is missing, damaged, a pickle, or no backbone.
    """
    path = Path(path)
    tensors = from_any_format(_read(path, lambda file, name: file.get_tensor(name)))
    if _PATCHES[0] not in tensors:
        raise CheckpointError(f"{path}: holds no DINOv3 backbone; `uika weights` lists the files that do")
    return tensors


def check_backbone(path: str | Path, config: BackboneConfig) -> None:
    """Make sure, from the file's header alone, that it holds a backbone of a size.

    Raises:
        CheckpointError: the file is missing, damaged or a pickle, or of another size; one sentence says which.
    """
    path = Path(path)
    shapes = _read(path, lambda file, name: tuple(file.get_slice(name).get_shape()))
    names = [_plain(name) for name in shapes]
    blocks = {int(found[1]) for name in names if (found := re.match(r"(?:blocks|layer)\.(\d+)\.", name))}
    patches = [shape for name, shape in shapes.items() if name.endswith(_PATCHES) and len(shape) == 4]
    if not blocks or len(patches) != 1:
        raise CheckpointError(f"{path}: holds no DINOv3 backbone; `uika weights` lists the files that do")
    found_size = (max(blocks) + 1, patches[0][0], patches[0][2])
    if found_size != (config.depth, config.dim, config.patch_size):
        raise CheckpointError(
            f"{path}: holds a backbone of {found_size[0]} blocks, {found_size[1]} channels and patches of "
            f"{found_size[2]} pixels, but {config.depth} blocks, {config.dim} channels and {config.patch_size} pixels "
            f"are needed{_known(config)}"
        )


def _known(config: BackboneConfig) -> str:
    name = KNOWN.get((config.depth, config.dim, config.patch_size))
    return f" ({name})" if name else ""


def from_any_format(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors under Meta's names, whichever of the two formats they come in."""
    if not any("embeddings." in name for name in tensors):
        return {name: value for name, value in tensors.items() if not name.startswith("local_")}
    result: dict[str, Tensor] = {}
    thirds: dict[str, dict[str, Tensor]] = {}
    for full, value in tensors.items():
        name = _plain(full)
        if found := _QUERY_KEY_VALUE.fullmatch(name):
            thirds.setdefault(_block(found[1]) + "attn.qkv." + found[3], {})[found[2]] = value
        else:
            result[_renamed(name)] = value[0] if name == "embeddings.mask_token" else value
    for name, parts in thirds.items():
        whole = next(iter(parts.values()))
        result[name] = torch.cat([parts.get(part, torch.zeros_like(whole)) for part in "qkv"])
    return result


def _renamed(name: str) -> str:
    for theirs, ours in _NAMES.items():
        if name.startswith(theirs):
            return ours + name.removeprefix(theirs)
    name = _block(name)
    for theirs, ours in _PARTS.items():
        name = name.replace(theirs, ours)
    return name


def _block(name: str) -> str:
    return re.sub(r"^layer\.", "blocks.", name)


def _plain(name: str) -> str:
    return re.sub(r"^(?:model\.|backbone\.)*", "", name)


def _read(path: Path, take: Callable[[Any, str], _T]) -> dict[str, _T]:
    """What `take` finds in the opened file under each of its names."""
    if not path.is_file():
        raise CheckpointError(f"{path}: no such weight file; `uika weights` says where to get it")
    if path.suffix in (".pth", ".pt", ".bin"):
        command = f"{_CONVERT} {path} {path.with_suffix('.safetensors')}"
        raise CheckpointError(f"{path}: is a pickle, which is not read here; convert it where you trust it: {command}")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: take(file, name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: damaged, truncated or no safetensors file ({error})") from error
