import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from uika.model import CheckpointError, ModelConfig, Reconstructor, build, load_checkpoint, save_checkpoint


@pytest.fixture
def saved(tmp_path: Path, small: ModelConfig) -> tuple[Path, Reconstructor]:
    model = build(small, seed=5)
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, model, provenance={"data": "none"})
    return path, model


def rewrite(path: Path, tensors: dict[str, torch.Tensor] | None = None, **metadata: str) -> None:
    with safe_open(path, framework="pt") as file:
        kept = file.metadata()
    save_file(load_file(path) if tensors is None else tensors, path, metadata={**kept, **metadata})


def test_same_seed_same_weights_and_global_generator_untouched(small: ModelConfig) -> None:
    torch.manual_seed(11)
    expected = torch.rand(3)
    torch.manual_seed(11)
    first, second, other = build(small, seed=1), build(small, seed=1), build(small, seed=2)
    assert torch.equal(torch.rand(3), expected)
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    assert not torch.equal(first.transformer.uv_token, other.transformer.uv_token)


def test_round_trip_is_exact(saved: tuple[Path, Reconstructor], make_inputs: Callable[..., dict[str, Any]]) -> None:
    path, model = saved
    loaded = load_checkpoint(path)
    assert loaded.config == model.config
    assert not loaded.training
    assert all(p.requires_grad for p in loaded.parameters())
    with torch.no_grad():
        first, second = model.eval()(**make_inputs()), loaded(**make_inputs())
    assert torch.equal(first.colors, second.colors)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_bfloat16_halves_the_file_and_keeps_the_positions(tmp_path: Path, saved: tuple[Path, Reconstructor]) -> None:
    path, model = saved
    half = tmp_path / "half.safetensors"
    save_checkpoint(half, model, dtype=torch.bfloat16)
    assert half.stat().st_size < 0.6 * path.stat().st_size
    loaded = load_checkpoint(half)
    assert all(p.dtype == torch.float32 for p in loaded.parameters())
    assert torch.equal(loaded.encoder.model.rope_embed.periods, model.encoder.model.rope_embed.periods)


def test_failed_save_leaves_the_old_file(saved: tuple[Path, Reconstructor], small: ModelConfig) -> None:
    path, _ = saved
    before = path.read_bytes()
    with torch.device("meta"):
        weightless = Reconstructor(small)
    with pytest.raises(Exception):  # noqa: B017 - whatever the writer says about tensors without data
        save_checkpoint(path, weightless)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nowhere\.safetensors: no such model file"):
        load_checkpoint(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize("keep", [0, 5, 1000, -100])
def test_truncated_file(saved: tuple[Path, Reconstructor], keep: int) -> None:
    path, _ = saved
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match="damaged or truncated"):
        load_checkpoint(path)


def test_wrong_version_and_format(saved: tuple[Path, Reconstructor]) -> None:
    path, _ = saved
    rewrite(path, version="99")
    with pytest.raises(CheckpointError, match="version 99 of the format, this program reads 1"):
        load_checkpoint(path)
    rewrite(path, format="splats")
    with pytest.raises(CheckpointError, match="not a uika-model file"):
        load_checkpoint(path)


def test_broken_config(saved: tuple[Path, Reconstructor]) -> None:
    path, model = saved
    rewrite(path, config="{")
    with pytest.raises(CheckpointError, match="unreadable config"):
        load_checkpoint(path)
    rewrite(path, config=json.dumps({**model.config.to_dict(), "depthness": 3}))
    with pytest.raises(CheckpointError, match="depthness"):
        load_checkpoint(path)


def test_missing_unknown_and_misshapen_tensors_are_listed(saved: tuple[Path, Reconstructor]) -> None:
    path, _ = saved
    tensors = load_file(path)
    tensors["stranger"] = torch.zeros(1)
    tensors["transformer.uv_token"] = torch.zeros(2, 3)
    del tensors["gs_decoder.mlp_net.layers.0.weight"]
    rewrite(path, tensors)
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    message = str(caught.value)
    assert "missing: gs_decoder.mlp_net.layers.0.weight" in message
    assert "unknown: stranger" in message
    assert "transformer.uv_token [2, 3] instead of [64, 32]" in message


def test_unknown_preset() -> None:
    with pytest.raises(ValueError, match="choose from tiny, base, paper"):
        build("huge")
