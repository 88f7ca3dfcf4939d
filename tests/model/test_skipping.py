import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from uika.model import FeatureCache, ModelConfig, Reconstructor, Session, build, compile_blocks
from uika.model.precision import computes_bfloat16
from uika.model.view_features import covered_tokens, occupied

Make = Callable[..., dict[str, Any]]
Perturb = Callable[[Reconstructor], Reconstructor]
NAMES = ("means", "quats", "scales", "opacities", "colors")


@pytest.fixture
def model(small: ModelConfig, perturb: Perturb) -> Reconstructor:
    return perturb(build(dataclasses.replace(small, image_size=64))).eval()


def portraits(make_inputs: Make, views: int) -> dict[str, Any]:
    """Photos with a background of a third, whose pixels reach half of the atlas."""
    inputs = make_inputs(views, side=64)
    inputs["masks"][..., :22] = 0
    return inputs


def run(model: Reconstructor, inputs: dict[str, Any], **options: Any) -> Any:
    with torch.no_grad():
        return model(**inputs, **options)


def worst(first: Any, second: Any) -> float:
    return max((first[name] - second[name]).abs().max().item() for name in NAMES)


def test_occupied_cells() -> None:
    maps = torch.zeros(2, 1, 8, 8)
    maps[0, 0, 3, 4] = 1e-3
    maps[1, 0, :2, :2] = torch.tensor([[1.0, 0.5], [0.0, 0.0]])
    cells = occupied(maps, (2, 4))
    assert cells.tolist() == [[False, False, True, False] + [False] * 4, [True] + [False] * 7]
    assert occupied(maps, (2, 4), 1.5 / 8).nonzero().tolist() == []
    assert occupied(maps, (2, 4), 1.4 / 8).nonzero().tolist() == [[1, 0]]


def test_covered_tokens() -> None:
    texel = torch.tensor([0, 1, 6 * 6 - 1])
    assert covered_tokens(texel, 6, 3).nonzero()[:, 0].tolist() == [0, 8]


def test_foreground_is_everything_when_there_is_no_background(model: Reconstructor, make_inputs: Make) -> None:
    inputs = make_inputs(2, side=32)
    inputs["pixel_uv"][:, :, 0] /= 0.66
    inputs["texel"] = torch.arange(48 * 48)
    count = len(inputs["texel"])
    surface = inputs["surface"]
    inputs["surface"] = dataclasses.replace(
        surface,
        points=torch.zeros(1, count, 3),
        quats=torch.eye(4)[:1].expand(1, count, 4),
        scales=torch.ones(1, count, 3),
    )
    dense, kept = run(model, inputs), run(model, inputs, keep="foreground")
    assert kept.report["skipped_patches"] == kept.report["skipped_tokens"] == 0
    assert worst(dense, kept) < 1e-5


def test_foreground_skips_what_is_empty_and_stays_close(model: Reconstructor, make_inputs: Make) -> None:
    inputs = portraits(make_inputs, 3)
    dense, kept = run(model, inputs), run(model, inputs, keep="foreground")
    assert dense.report["skipped_patches"] == dense.report["skipped_tokens"] == 0
    assert 0 < kept.report["skipped_patches"] < kept.report["patches"] == 3 * 32
    assert 0 < kept.report["skipped_tokens"] < kept.report["tokens"] == 64
    assert 0 < worst(dense, kept) < 0.02


def test_patches_at_the_edge_count_above_an_eighth(model: Reconstructor, make_inputs: Make) -> None:
    inputs = make_inputs(1, side=64)
    for columns, kept in ((0, 8), (2, 8), (3, 12)):  # of the 16 in each patch of the second column
        inputs["masks"][:] = 0
        inputs["masks"][..., 32 - columns :] = 1
        views = model.encode(inputs["images"], inputs["masks"], inputs["pixel_uv"], keep="foreground")
        assert len(views[0][0].screen) == kept


def test_foreground_ignores_the_background(model: Reconstructor, make_inputs: Make) -> None:
    """Patches without any foreground are not looked at."""
    inputs = portraits(make_inputs, 2)
    changed = {**inputs, "images": inputs["images"].clone(), "masks": inputs["masks"].clone()}
    inputs["masks"][..., :16] = 0
    changed["masks"][..., :16] = 0
    changed["images"][..., :16] = 0.5
    first, second = (run(model, each, keep="foreground") for each in (inputs, changed))
    assert worst(first, second) == 0
    assert worst(run(model, inputs), run(model, changed)) > 0


def test_items_of_different_lengths_equal_themselves(model: Reconstructor, make_inputs: Make) -> None:
    inputs = make_inputs(2, batch=2, side=32)
    inputs["masks"][1, ..., :16] = 0
    both = run(model, inputs, keep="foreground")
    for item in range(2):
        rows = {name: inputs[name][item : item + 1] for name in ("images", "masks", "pixel_uv")}
        alone = run(model, {**inputs, **rows}, keep="foreground")
        for name in NAMES:
            torch.testing.assert_close(both[name][item : item + 1], alone[name], rtol=0, atol=1e-5)


def test_photos_that_show_nothing(model: Reconstructor, make_inputs: Make) -> None:
    inputs = make_inputs(2)
    inputs["masks"][:] = 0
    result = run(model, inputs, keep="foreground")
    assert result.report["skipped_patches"] == result.report["patches"]
    assert all(bool(torch.isfinite(result[name]).all()) for name in NAMES)


@pytest.mark.parametrize("keep", ["all", "foreground"])
def test_cache_encodes_only_what_is_new(model: Reconstructor, make_inputs: Make, keep: str) -> None:
    inputs, cache = portraits(make_inputs, 3), FeatureCache()
    fresh = run(model, inputs, keep=keep)
    first = {**inputs, **{name: inputs[name][:, :2] for name in ("images", "masks", "pixel_uv")}}
    run(model, first, keep=keep, cache=cache)
    grown = run(model, inputs, keep=keep, cache=cache)
    assert (cache.misses, cache.hits) == (6, 4)
    assert worst(grown, fresh) < 5e-6
    inputs["pixel_uv"] = inputs["pixel_uv"] * 0.99
    run(model, inputs, keep=keep, cache=cache)
    assert (cache.misses, cache.hits) == (9, 7)  # other maps: the photos' own features still serve


def test_cache_forgets_the_oldest() -> None:
    cache, asked = FeatureCache(capacity=2), []

    def compute(indices: list[int]) -> list[int]:
        asked.append(indices)
        return indices

    cache.resolve("screen", [b"a", b"b"], compute)
    cache.resolve("screen", [b"a"], compute)
    cache.resolve("screen", [b"c"], compute)
    assert cache.resolve("screen", [b"a", b"b", b"b"], compute) == [0, 1, 1]
    assert asked == [[0, 1], [0], [1]]
    with pytest.raises(ValueError, match="capacity"):
        FeatureCache(0)


def test_session_grows_and_refreshes(model: Reconstructor, make_inputs: Make) -> None:
    inputs = portraits(make_inputs, 4)
    rows = [inputs[name] for name in ("images", "masks", "pixel_uv")]
    session = Session(model, inputs["texel"], inputs["surface"])
    start = session.add(*(row[:, :3] for row in rows))
    three = {**inputs, **{n: inputs[n][:, :3] for n in ("images", "masks", "pixel_uv")}}
    assert worst(start, run(model, three, keep="foreground")) < 5e-6
    grown = session.add(*(row[:, 3:] for row in rows))
    whole = run(model, inputs, keep="foreground")
    assert len(session) == 4
    assert grown.report["reused_views"] == 3
    assert torch.equal(grown.aggregate, whole.aggregate)
    assert 0 < worst(grown, whole) < 0.3 * worst(start, whole) + 1e-3
    assert worst(session.refresh(), whole) < 5e-6
    with pytest.raises(ValueError, match="no photos"):
        Session(model, inputs["texel"], inputs["surface"]).refresh()


def test_bfloat16_weights_stay_close(small: ModelConfig, perturb: Perturb, make_inputs: Make) -> None:
    model, half, inputs = perturb(build(small)).eval(), perturb(build(small)).eval(), make_inputs(2)
    half.halve()
    assert half.transformer.layers[0].attn.to_q.weight.dtype == torch.bfloat16
    assert half.gs_decoder.mlp_net.layers[0].weight.dtype == torch.float32
    first, second = run(model, inputs), run(half, inputs)
    assert second.means.dtype == torch.float32
    assert 0 < worst(first, second) < 0.02


def test_half_precision_instructions_are_found_without_asking_for_them() -> None:
    assert isinstance(computes_bfloat16(torch.device("cpu")), bool)


def test_many_views(model: Reconstructor, make_inputs: Make) -> None:
    inputs = make_inputs(64, side=32)
    result: Any = run(model, inputs, keep="foreground")
    assert result.report["views"] == 64
    order = torch.randperm(64, generator=torch.Generator().manual_seed(1))
    shuffled = {**inputs, **{name: inputs[name][:, order] for name in ("images", "masks", "pixel_uv")}}
    other: Any = run(model, shuffled, keep="foreground")
    colors: Tensor = result.colors - other.colors
    assert colors.abs().max() < 1e-5


def test_rows_in_parts_give_the_same(model: Reconstructor, make_inputs: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = make_inputs(3)
    whole = run(model, inputs)
    monkeypatch.setattr("uika.model.mm_block._ROWS", 5)
    assert worst(whole, run(model, inputs)) < 5e-6


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # what the compiler of torch warns of is its own affair
def test_compiled_blocks_give_the_same(model: Reconstructor, make_inputs: Make) -> None:
    inputs = make_inputs(2)
    plain = run(model, inputs)
    compile_blocks(model.transformer.layers)
    assert worst(plain, run(model, inputs)) < 1e-5
