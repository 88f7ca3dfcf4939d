import dataclasses
import json

import pytest
import torch

from uika.model import PRESETS, ModelConfig, Reconstructor


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_json_round_trip(name: str) -> None:
    config = PRESETS[name]
    assert config.name == name
    assert ModelConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_unknown_and_missing_fields_are_named() -> None:
    values = PRESETS["tiny"].to_dict()
    with pytest.raises(ValueError, match="unknown fields in ModelConfig: colour"):
        ModelConfig.from_dict({**values, "colour": 1})
    with pytest.raises(ValueError, match="unknown fields in UvConfig: kind"):
        ModelConfig.from_dict({**values, "uv": {"kind": 1}})
    del values["layers"]
    with pytest.raises(ValueError, match="layers"):
        ModelConfig.from_dict(values)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("image_size", 250),
        ("dim", 190),
        ("outputs", (1, 2, 3, 9)),
        ("outputs", (1, 2, 3, 3)),
        ("token_grid", 31),
        ("fusion", "sum"),
        ("scope", "hair"),
    ],
)
def test_impossible_values_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"model config 'tiny': .*{field}"):
        dataclasses.replace(PRESETS["tiny"], **{field: value})  # type: ignore[arg-type]


def test_paper_preset_has_the_size_of_the_released_model() -> None:
    with torch.device("meta"):
        model = Reconstructor(PRESETS["paper"])
    trainable = sum(p.numel() for p in model.parameters() if p.requires_grad)
    # The released last block also holds context queries that nothing reads.
    unread = 2 * (1024 * 1024 + 1024 + 64)
    assert trainable == 553_985_567 - unread


def test_base_preset_can_be_built() -> None:
    with torch.device("meta"):
        model = Reconstructor(PRESETS["base"])
    assert 30e6 < sum(p.numel() for p in model.parameters()) < 150e6
