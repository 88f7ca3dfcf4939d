from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from tests.model.released_files import randomize
from uika.model import BackboneConfig, CheckpointError
from uika.model.backbone import VisionTransformer
from uika.model.dinov3 import load_backbone

CONFIG = BackboneConfig(dim=32, depth=2, heads=2, taps=(0, 1))


@pytest.fixture(scope="module")
def meta_format() -> dict[str, Tensor]:
    """Meta's names, with the extras of its files."""
    model = VisionTransformer(CONFIG)
    tensors = randomize({name: tuple(value.shape) for name, value in model.state_dict().items()})
    return {**tensors, "mask_token": torch.zeros(1, 32), "local_cls_norm.weight": torch.ones(32)}


@pytest.fixture(scope="module")
def hugging_face_format(meta_format: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same weights as Hugging Face names, splits and leaves them out."""
    tensors = {
        "embeddings.cls_token": meta_format["cls_token"],
        "embeddings.register_tokens": meta_format["storage_tokens"],
        "embeddings.mask_token": meta_format["mask_token"][None],
        "embeddings.patch_embeddings.weight": meta_format["patch_embed.proj.weight"],
        "embeddings.patch_embeddings.bias": meta_format["patch_embed.proj.bias"],
        "norm.weight": meta_format["norm.weight"],
        "norm.bias": meta_format["norm.bias"],
    }
    for block in range(2):
        ours, theirs = f"blocks.{block}.", f"layer.{block}."
        weights = meta_format[f"{ours}attn.qkv.weight"].chunk(3)
        biases = meta_format[f"{ours}attn.qkv.bias"].chunk(3)
        for letter, weight, bias in zip("qkv", weights, biases, strict=True):
            tensors[f"{theirs}attention.{letter}_proj.weight"] = weight
            if letter != "k":
                tensors[f"{theirs}attention.{letter}_proj.bias"] = bias
        for kind in ("weight", "bias"):
            tensors[f"{theirs}attention.o_proj.{kind}"] = meta_format[f"{ours}attn.proj.{kind}"]
            tensors[f"{theirs}mlp.up_proj.{kind}"] = meta_format[f"{ours}mlp.fc1.{kind}"]
            tensors[f"{theirs}mlp.down_proj.{kind}"] = meta_format[f"{ours}mlp.fc2.{kind}"]
            for norm in ("norm1", "norm2"):
                tensors[f"{theirs}{norm}.{kind}"] = meta_format[f"{ours}{norm}.{kind}"]
        for scale in (1, 2):
            tensors[f"{theirs}layer_scale{scale}.lambda1"] = meta_format[f"{ours}ls{scale}.gamma"]
    return tensors


def outputs(path: Path) -> Tensor:
    model = VisionTransformer(CONFIG).eval()
    load_backbone(model, path)
    with torch.no_grad():
        return torch.cat(model(torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(2))))


def write(path: Path, tensors: dict[str, Tensor]) -> Path:
    save_file({name: value.contiguous().clone() for name, value in tensors.items()}, path)
    return path


@pytest.mark.parametrize("prefix", ["", "model.", "backbone."])
def test_both_formats_give_the_same_features(
    meta_format: dict[str, Tensor], hugging_face_format: dict[str, Tensor], tmp_path: Path, prefix: str
) -> None:
    meta = outputs(write(tmp_path / "meta.safetensors", meta_format))
    named = {prefix + name: value for name, value in hugging_face_format.items()}
    hugging = outputs(write(tmp_path / "hf.safetensors", named))
    assert meta.abs().max() > 1
    torch.testing.assert_close(hugging, meta, rtol=0, atol=1e-5)


def test_misfits_are_listed(hugging_face_format: dict[str, Tensor], tmp_path: Path) -> None:
    tensors = dict(hugging_face_format)
    del tensors["layer.1.mlp.up_proj.bias"]
    tensors["norm.bias"] = torch.zeros(31)
    tensors["layer.0.mlp.gate_proj.weight"] = torch.zeros(2, 2)
    with pytest.raises(CheckpointError) as caught:
        outputs(write(tmp_path / "hf.safetensors", tensors))
    message = str(caught.value)
    assert "missing: blocks.1.mlp.fc1.bias" in message
    assert "unknown: blocks.0.mlp.gate_proj.weight" in message
    assert "misshapen: norm.bias [31] instead of [32]" in message


def test_pickles_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "dinov3.pth"
    path.write_bytes(b"\x80\x04N.")
    with pytest.raises(CheckpointError, match="is a pickle, which is not read here; convert it"):
        outputs(path)
    with pytest.raises(CheckpointError, match="no such weight file"):
        outputs(tmp_path / "nowhere.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"12345678901")
    with pytest.raises(CheckpointError, match="damaged"):
        outputs(tmp_path / "bad.safetensors")
