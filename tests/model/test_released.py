from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from tests.model.released_files import SMALL, released_tensors, write
from uika.model import CheckpointError, FeatureCache, released
from uika.uv import aggregate, reproject

Photos = tuple[Tensor, Tensor, Tensor]


@pytest.fixture(scope="module")
def tensors() -> dict[str, Tensor]:
    return released_tensors()


@pytest.fixture(scope="module")
def file(tensors: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("released"), tensors)


@pytest.fixture(scope="module")
def model(file: Path) -> released.ReleasedModel:
    return released.load(file)


@pytest.fixture(scope="module")
def photos() -> Photos:
    """Images, masks and UV maps [1,3,...] of 64x64 pixels, their heads in the middle."""
    generator = torch.Generator().manual_seed(4)
    images = torch.rand(1, 3, 3, 64, 64, generator=generator)
    masks = torch.zeros(1, 3, 1, 64, 64)
    masks[..., 10:40, 20:50] = 1
    centers = (torch.arange(64) + 0.5) / 64
    uv = torch.stack([centers.expand(64, 64), centers[:, None].expand(64, 64)]).expand(1, 3, 2, 64, 64)
    return images, masks, uv


def test_sizes_come_from_the_file(model: released.ReleasedModel) -> None:
    config = model.network.config
    assert (config.token_grid, config.map_size, config.dim, config.heads, config.layers) == (8, 32, 32, 2, 4)
    assert config.dpt_projections == SMALL.dpt_projections
    assert config.outputs == (1, 2, 3, 4)
    assert config.backbone.depth == 6
    assert config.uv.grid == "corners"
    assert not model.training
    assert (
        len(model.points)
        == len(model.texel)
        == int(released_tensors()["renderer.flame_model.valid_mask_flatten"].sum())
    )


def test_released_arithmetic_from_photos_to_gaussians(
    model: released.ReleasedModel, tensors: dict[str, Tensor], photos: Photos
) -> None:
    """Step by step with plain functions, from the estimator's maps to the activations of every attribute."""
    images, masks, _ = photos
    uv = model.estimate(images)
    assert uv.shape == (1, 3, 2, 64, 64)
    assert 0 < uv.min() < uv.max() < 1
    result = model(images, masks)
    views, _ = reproject(images, uv, masks, 64, grid="corners")
    pooled = aggregate(images, uv, masks, 32, grid="corners", normalization="max")
    observed = torch.cat([pooled.rgb, pooled.confidence], dim=1)
    network = model.network
    encoder = network.encoder
    with torch.no_grad():
        screen = torch.cat(encoder.screen(images[0]))[None]
        maps = encoder.uv(views[0])
        assert maps is not None
        tokens = network.transformer(screen, torch.cat(maps)[None])
        dense = network.gs_decoder.dpt_decoder(tokens, observed)
    valid = tensors["renderer.flame_model.valid_mask_flatten"].view(32, 32)
    x = dense[0, :, valid].T
    for layer in (0, 2, 4):
        key = f"gs_decoder.mlp_net.layers.{layer}"
        x = functional.linear(x, tensors[f"{key}.weight"], tensors[f"{key}.bias"])
        x = x if layer == 4 else functional.silu(x)
    seen = observed[0, :, valid].T

    def head(name: str, features: Tensor) -> Tensor:
        key = f"gs_decoder.gs_net.out_layers.{name}"
        return functional.linear(features, tensors[f"{key}.weight"], tensors[f"{key}.bias"])

    mixed = head("shs", torch.cat([x, seen], dim=1)).sigmoid()
    expected = {
        "means": tensors["renderer.flame_model.v_template_pix"] + (head("xyz", x).sigmoid() - 0.5) * 0.2,
        "quats": functional.normalize(head("rotation", x), dim=1),
        "scales": head("scaling", x).exp().clamp(0, 0.01),
        "opacities": head("opacity", x).sigmoid()[:, 0],
        "colors": mixed[:, 3:] * mixed[:, :3] + (1 - mixed[:, 3:]) * seen[:, :3],
    }
    for name, value in expected.items():
        torch.testing.assert_close(result[name][0], value, rtol=0, atol=1e-5)
    means, _, _, _, colors = result
    assert torch.equal(means, result.means)
    assert torch.equal(colors, result.colors)


def test_given_maps_replace_the_estimator(model: released.ReleasedModel, photos: Photos) -> None:
    images, masks, uv = photos
    estimated = model.estimate(images)
    first, second = model(images, masks), model(images, masks, pixel_uv=estimated)
    assert torch.equal(first.colors, second.colors)
    assert not torch.equal(model(images, masks, uv).colors, first.colors)


def test_order_of_views_does_not_matter(model: released.ReleasedModel, photos: Photos) -> None:
    images, masks, _ = photos
    order = [2, 0, 1]
    first, second = model(images, masks), model(images[:, order], masks[:, order])
    for one, other in zip(first, second, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=2e-5)


def test_cache_changes_nothing_and_keeps_the_photos(model: released.ReleasedModel, photos: Photos) -> None:
    images, masks, uv = photos
    cache = FeatureCache()
    model(images[:, :2], masks[:, :2], uv[:, :2], cache=cache)
    before = cache.misses
    grown = model(images, masks, uv, cache=cache)
    assert cache.misses - before == 2  # one photo, in both spaces
    assert grown.report["reused_views"] == 4
    fresh = model(images, masks, uv)
    for one, other in zip(grown, fresh, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


def test_bfloat16_weights_halve_the_model(file: Path, model: released.ReleasedModel, photos: Photos) -> None:
    images, masks, uv = photos
    half = released.load(file, dtype=torch.bfloat16)
    assert half.network.transformer.layers[0].attn.to_q.weight.dtype == torch.bfloat16
    assert half.network.encoder.model.rope_embed.periods.dtype == torch.float32
    first, second = model(images, masks, uv), half(images, masks, uv)
    assert second.means.dtype == torch.float32
    assert 0 < (first.means - second.means).abs().max() < 5e-3
    assert (first.colors - second.colors).abs().max() < 0.1


def test_unused_keys_are_known_with_their_reasons(model: released.ReleasedModel, tensors: dict[str, Tensor]) -> None:
    kept = {"valid_mask_flatten", "v_template_pix", "pix_to_v_idx_flatten", "pix_bary_flatten"}
    used = {name for name in tensors if name.rpartition(".")[2] in kept}
    network = {name for name in tensors if not name.startswith("renderer.")} - set(model.unused)
    assert len(network) == len([n for n in model.state_dict() if n.startswith(("network.", "estimator."))])
    assert used | network | set(model.unused) == set(tensors)
    assert "encoder.model.mask_token" in model.unused
    assert "transformer.layers.3.attn2.norm_added_q.weight" in model.unused
    assert "transformer.layers.2.attn2.norm_added_q.weight" not in model.unused


def test_missing_misshapen_and_unknown_keys_are_listed(tensors: dict[str, Tensor], tmp_path: Path) -> None:
    changed = dict(tensors)
    del changed["gs_decoder.gs_net.out_layers.xyz.bias"]
    del changed["uv_wrapper.model.uv_head.norm.weight"]
    changed["transformer.linear_cond_proj2.bias"] = torch.zeros(31)
    changed["discriminator.weight"] = torch.zeros(2)
    path = write(tmp_path, changed)
    with pytest.raises(CheckpointError) as caught:
        released.load(path)
    message = str(caught.value)
    assert "missing: gs_decoder.gs_net.out_layers.xyz.bias, uv_wrapper.model.uv_head.norm.weight" in message
    assert "misshapen: transformer.linear_cond_proj2.bias [31] instead of [32]" in message
    assert "discriminator.weight" in message
    with pytest.raises(CheckpointError) as caught:
        released.load(path, strict=False)
    assert "discriminator" not in str(caught.value)


@pytest.mark.parametrize("name", ["transformer.uv_token", "encoder.model.storage_tokens"])
def test_missing_sizes_are_named(tensors: dict[str, Tensor], tmp_path: Path, name: str) -> None:
    path = write(tmp_path, {key: value for key, value in tensors.items() if key != name})
    with pytest.raises(CheckpointError, match=name):
        released.load(path)


def test_file_without_head_tables_takes_given_texels(
    tensors: dict[str, Tensor], tmp_path: Path, model: released.ReleasedModel, photos: Photos
) -> None:
    bare = write(tmp_path, {key: value for key, value in tensors.items() if not key.startswith("renderer.")})
    with pytest.raises(CheckpointError, match=r"valid_mask_flatten, .*v_template_pix; give `texels`"):
        released.load(bare)
    again = released.load(bare, texels=(model.texel, model.points))
    assert torch.equal(again(*photos).means, model(*photos).means)


def test_tables_that_disagree_are_refused(tensors: dict[str, Tensor], tmp_path: Path) -> None:
    name = "renderer.flame_model.v_template_pix"
    path = write(tmp_path, {**tensors, name: tensors[name][1:]})
    with pytest.raises(CheckpointError, match="v_template_pix"):
        released.load(path)


def test_estimator_file(
    tensors: dict[str, Tensor], tmp_path: Path, model: released.ReleasedModel, photos: Photos
) -> None:
    prefix = "uv_wrapper.model."
    own = {f"fuvt.{key.removeprefix(prefix)}": value for key, value in tensors.items() if key.startswith(prefix)}
    teacher = {"uv_wrapper.model.backbone.weight": torch.zeros(3)}
    path = write(tmp_path, {**own, **teacher}, "fuvt.safetensors")
    estimator = released.load_estimator(path)
    assert torch.equal(estimator(photos[0]), model.estimate(photos[0]))
    without = write(tmp_path, {key: value for key, value in tensors.items() if not key.startswith(prefix)})
    with pytest.raises(CheckpointError, match=r"uv_wrapper\.model"):
        released.load(without)
    both = released.load(without, estimator=path)
    assert torch.equal(both(*photos[:2]).means, model(*photos[:2]).means)
    del own["fuvt.uv_head.scratch.refinenet4.out_conv.bias"]
    with pytest.raises(CheckpointError, match=r"missing: .*uv_head.scratch.refinenet4.out_conv.bias"):
        released.load_estimator(write(tmp_path, own, "broken.safetensors"))


def test_damaged_and_missing_files(file: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such weight file"):
        released.load(tmp_path / "nowhere.safetensors")
    stump = tmp_path / "stump.safetensors"
    stump.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(CheckpointError, match="damaged"):
        released.load(stump)


def test_photos_of_odd_sizes_are_refused(model: released.ReleasedModel) -> None:
    with pytest.raises(ValueError, match="multiples of 16"):
        model(torch.rand(1, 1, 3, 60, 64), torch.ones(1, 1, 1, 60, 64))
