"""Against recorded outputs of the released network at reduced sizes (not part of the repository)."""

import dataclasses
import json

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from tests.recorded import PARITY
from tests.recorded import recorded as recorded_outputs
from uika.model import PRESETS, BackboneConfig, EstimatorConfig, Reconstructor
from uika.model.backbone import VisionTransformer
from uika.model.estimator import Aggregator
from uika.model.fusion import Encoder
from uika.model.mm_block import MMBlock
from uika.model.uv_head import UvHead

pytestmark = recorded_outputs

TOLERANCE = {"rtol": 0.0, "atol": 5e-5}
# Weights of the released model that no output depends on.
UNREAD = ("mask_token", "add_q_proj", "norm_added_q")


def load(name: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """(weights, inputs and outputs)."""
    data = load_file(PARITY / f"{name}.safetensors")
    weights = {key[2:]: value for key, value in data.items() if key.startswith("w/")}
    return weights, data


def fit(module: nn.Module, weights: dict[str, Tensor]) -> None:
    outcome = module.load_state_dict(weights, strict=False)
    assert outcome.missing_keys == []
    assert [key for key in outcome.unexpected_keys if not any(part in key for part in UNREAD)] == []


@pytest.mark.parametrize("last", [False, True])
def test_dual_attention_block(last: bool) -> None:
    weights, data = load("mm_block_last" if last else "mm_block")
    block = MMBlock(64, 4, last=last)
    fit(block, weights)
    with torch.no_grad():
        x, cond, cond2 = block(data["in/x"], data["in/cond"], data["in/cond2"])
    torch.testing.assert_close(x, data["out/x"], **TOLERANCE)
    if not last:
        assert cond2 is not None
        torch.testing.assert_close(cond, data["out/cond"], **TOLERANCE)
        torch.testing.assert_close(cond2, data["out/cond2"], **TOLERANCE)


def test_backbone() -> None:
    weights, data = load("dinov3_tiny")
    model = VisionTransformer(BackboneConfig(dim=32, depth=3, heads=2, taps=(0, 2)))
    fit(model, weights)
    sin, cos = model.rope_embed(3, 5)
    torch.testing.assert_close(sin, data["out/rope_sin"], **TOLERANCE)
    torch.testing.assert_close(cos, data["out/rope_cos"], **TOLERANCE)
    with torch.no_grad():
        taps = model(data["in/x"])
    for features, name in zip(taps, ("layer0", "layer2"), strict=True):
        torch.testing.assert_close(features, data[f"out/{name}"], **TOLERANCE)


def test_encoder_and_its_fusion_heads() -> None:
    weights, data = load("dino_fusion_wrapper")
    backbone = BackboneConfig(dim=32, depth=24, heads=2, taps=(4, 11, 17, 23))
    encoder = Encoder(dataclasses.replace(PRESETS["paper"], backbone=backbone, dim=40, heads=2))
    fit(encoder, weights)
    taps = tuple(data[f"in/feats.{index}"] for index in range(4))
    image = data["in/image"]
    assert encoder.uv_fusion_head is not None
    with torch.no_grad():
        for head, name in ((encoder.fusion_head, "head"), (encoder.uv_fusion_head, "uv_head")):
            fused = head(taps).transpose(1, 2).unflatten(2, (3, 4))
            torch.testing.assert_close(fused, data[f"out/{name}_from_feats"], **TOLERANCE)
        for tokens, name in ((encoder.screen(image), "screen"), (encoder.uv(image), "uv")):
            assert tokens is not None
            torch.testing.assert_close(torch.stack(tokens), data[f"out/{name}"], **TOLERANCE)


def test_estimator_aggregator() -> None:
    weights, data = load("aggregator")
    backbone = BackboneConfig(dim=64, depth=2, heads=4, taps=(1,))
    aggregator = Aggregator(EstimatorConfig(backbone=backbone, heads=4, channels=(8, 8, 8, 8), features=8))
    fit(aggregator, weights)
    with torch.no_grad():
        features = aggregator.features(data["in/images"])
        outputs = aggregator.exchange(features, (3, 5))
    torch.testing.assert_close(features.flatten(0, 1), data["out/patch_tokens"], **TOLERANCE)
    for index, output in enumerate(outputs):
        torch.testing.assert_close(output, data[f"out/out.{index}"], **TOLERANCE)


@pytest.mark.parametrize(("suffix", "grid"), [("", (4, 4)), ("_rect", (4, 6))])
def test_estimator_head(suffix: str, grid: tuple[int, int]) -> None:
    weights, data = load("dpt_head_fuvt")
    backbone = BackboneConfig(dim=16, depth=1, heads=1, taps=(0,))
    head = UvHead(EstimatorConfig(backbone=backbone, heads=1, channels=(8, 16, 24, 24), features=16))
    fit(head, weights)
    with torch.no_grad():
        uv = head([data[f"in/tokens{suffix}.{index}"] for index in range(4)], grid)
    torch.testing.assert_close(uv.permute(0, 1, 3, 4, 2), data[f"out/uv{suffix}"], **TOLERANCE)


def test_paper_preset_has_the_released_names_and_shapes() -> None:
    recorded = json.loads((PARITY / "state_dict_uika.json").read_text())["state_dict"]
    released = {
        name: entry["shape"]
        for name, entry in recorded.items()
        if name.startswith(("encoder.", "transformer.", "gs_decoder."))
        and "mask_token" not in name
        and not (name.startswith("transformer.layers.11.") and any(part in name for part in UNREAD))
    }
    with torch.device("meta"):
        model = Reconstructor(PRESETS["paper"])
    assert {name: list(value.shape) for name, value in model.state_dict().items()} == released
