"""Against recorded outputs of the released reprojection (not part of the repository)."""

import pytest
import torch
from safetensors.torch import load_file

from tests.recorded import PARITY, recorded
from uika.uv import aggregate, reproject

FILE = PARITY / "uv_reproject.safetensors"
pytestmark = recorded


@pytest.fixture(scope="module")
def data() -> dict[str, torch.Tensor]:
    return load_file(FILE)


def test_per_view_images(data: dict[str, torch.Tensor]) -> None:
    colors, _ = reproject(data["in/rgb"], data["in/uv"], data["in/mask"], 32, grid="corners")
    torch.testing.assert_close(colors, data["out/per_view"], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("name", "items"), [("aggr", slice(None)), ("aggr_b1", slice(1, 2))])
def test_aggregate(data: dict[str, torch.Tensor], name: str, items: slice) -> None:
    inputs = (data["in/rgb"][items], data["in/uv"][items], data["in/mask"][items])
    result = aggregate(*inputs, 24, grid="corners", normalization="max")
    both = torch.cat([result.rgb, result.confidence], dim=1)
    torch.testing.assert_close(both, data[f"out/{name}"], rtol=0, atol=1e-6)


def test_empty_masks(data: dict[str, torch.Tensor]) -> None:
    masks = torch.zeros_like(data["in/mask"])
    result = aggregate(data["in/rgb"], data["in/uv"], masks, 24, grid="corners", normalization="max")
    both = torch.cat([result.rgb, result.confidence], dim=1)
    torch.testing.assert_close(both, data["out/empty_aggr"], rtol=0, atol=1e-6)
