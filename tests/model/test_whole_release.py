"""Complete models under the released key names, read from their files, against an independent restatement."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.model.released_files import SMALL, SMALL_ESTIMATOR, released_tensors, write
from tests.model.restatement import Restatement
from uika.model import BackboneConfig, EstimatorConfig, ModelConfig, released

# The depths, taps and outputs of the release with narrow layers.
DEEP = dataclasses.replace(
    SMALL,
    map_size=40,
    token_grid=10,
    backbone=BackboneConfig(dim=32, depth=24, heads=2, taps=(4, 11, 17, 23), frozen=True),
    dim=48,
    heads=3,
    layers=12,
    outputs=(3, 6, 9, 12),
    dpt_projections=(12, 16, 24, 28),
    dpt_features=20,
    mlp_width=36,
)
DEEP_ESTIMATOR = EstimatorConfig(
    backbone=BackboneConfig(dim=48, depth=12, heads=3, taps=(11,)), heads=3, channels=(8, 16, 24, 32), features=24
)
# Patches, heads and storage tokens of other numbers than the release has.
ODD = dataclasses.replace(
    SMALL,
    map_size=24,
    token_grid=6,
    backbone=BackboneConfig(dim=64, depth=12, heads=4, taps=(2, 5, 8, 11), patch_size=8, storage_tokens=2, frozen=True),
    dim=40,
    heads=5,
    layers=8,
    outputs=(2, 4, 6, 8),
)
ODD_ESTIMATOR = dataclasses.replace(
    SMALL_ESTIMATOR, backbone=BackboneConfig(dim=64, depth=3, heads=2, taps=(2,), patch_size=8, storage_tokens=1)
)
SIZES = {"small": (SMALL, SMALL_ESTIMATOR), "deep": (DEEP, DEEP_ESTIMATOR), "odd": (ODD, ODD_ESTIMATOR)}


def photos(batch: int, views: int, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Noise with heads of soft outlines; the last view of the last head shows nothing."""
    generator = torch.Generator().manual_seed(batch + views)
    images = torch.rand(batch, views, 3, height, width, generator=generator)
    masks = torch.zeros(batch, views, 1, height, width)
    masks[..., height // 6 : -height // 8, width // 5 : -width // 4] = 0.02
    masks[..., height // 5 : -height // 5, width // 4 : -width // 3] = 1
    if views > 1:
        masks[-1, -1] = 0
    return images, masks


@pytest.mark.parametrize(("batch", "views", "height", "width"), [(1, 1, 64, 64), (2, 3, 48, 48)])
@pytest.mark.parametrize("size", SIZES)
def test_every_attribute(size: str, batch: int, views: int, height: int, width: int, tmp_path: Path) -> None:
    config, estimator = SIZES[size]
    tensors = released_tensors(config, estimator)
    model = released.load(write(tmp_path, tensors))
    expected = Restatement(tensors, config.backbone.taps, config.outputs)
    images, masks = photos(batch, views, height, width)
    uv = model.estimate(images)
    # A coordinate that lies between two texels may fall to either side, so that the maps are compared by themselves.
    torch.testing.assert_close(uv.double(), expected.estimate(images), rtol=0, atol=5e-5)
    result = model(images, masks)
    for name, value in expected(images, masks, uv).items():
        torch.testing.assert_close(result[name].double(), value, rtol=0, atol=5e-5, msg=lambda m, n=name: f"{n}: {m}")


def test_wide_photos_and_given_maps(tmp_path: Path) -> None:
    tensors = released_tensors(DEEP, DEEP_ESTIMATOR)
    model = released.load(write(tmp_path, tensors))
    expected = Restatement(tensors, DEEP.backbone.taps, DEEP.outputs)
    images, masks = photos(1, 2, 48, 80)
    torch.testing.assert_close(model.estimate(images).double(), expected.estimate(images), rtol=0, atol=5e-5)
    uv = torch.rand(1, 2, 2, 48, 80, generator=torch.Generator().manual_seed(2)) * 1.2 - 0.1
    result = model(images, masks, pixel_uv=uv)
    for name, value in expected(images, masks, uv).items():
        torch.testing.assert_close(result[name].double(), value, rtol=0, atol=5e-5, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("config", [DEEP, ODD])
def test_sizes_are_read_from_the_file(config: ModelConfig, tmp_path: Path) -> None:
    read = released.load(write(tmp_path, released_tensors(config, DEEP_ESTIMATOR))).network.config
    assert dataclasses.replace(read, name=config.name, image_size=config.image_size, backbone=config.backbone) == config
    assert dataclasses.replace(read.backbone, layer_scale=config.backbone.layer_scale) == config.backbone
