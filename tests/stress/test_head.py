"""Catalogue lines 33 to 40: heads, texture maps, photos. Line 40 is held by tests/train/test_train.py."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika.head import HeadParameters, load_head, pose_vertices, rodrigues, surface_frames
from uika.photo import PhotoError
from uika.photo.read import read
from uika.uv import aggregate

from .conftest import Worst

SIDE = 12


@given(exponent=st.floats(-30, 0.5), seed=st.integers(0, 2**31))
def test_33_rotations_near_zero_have_gradients(worst: Worst, exponent: float, seed: int) -> None:
    axis = torch.randn(3, generator=torch.Generator().manual_seed(seed))
    turn = (10**exponent * axis / axis.norm()).requires_grad_()
    wanted = torch.linalg.matrix_exp(_skew(turn.detach().double()))
    found = rodrigues(turn)
    (found * torch.randn(3, 3, generator=torch.Generator().manual_seed(1))).sum().backward()
    assert turn.grad is not None and torch.isfinite(turn.grad).all() and turn.grad.any()
    assert worst("matrix", float((found.detach().double() - wanted).abs().max())) < 2e-6


def test_33_a_head_at_rest_has_gradients() -> None:
    head = sphere_head()
    zeros = {k: v.requires_grad_() for k, v in vars(HeadParameters.zeros(head)).items()}
    pose_vertices(head, HeadParameters(**zeros)).square().sum().backward()
    for name in ("rotation", "neck", "jaw", "eyes"):
        assert zeros[name].grad is not None and torch.isfinite(zeros[name].grad).all() and zeros[name].grad.any(), name


def _skew(axis: torch.Tensor) -> torch.Tensor:
    x, y, z = axis.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


@given(seed=st.integers(0, 2**31))
def test_34_texture_coordinates_out_of_range_count_nothing(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    images, masks = torch.rand(1, 1, 3, SIDE, SIDE, generator=g), torch.ones(1, 1, 1, SIDE, SIDE)
    uv = 3 * torch.rand(1, 1, 2, SIDE, SIDE, generator=g) - 1
    uv[0, 0, 0, ::3], uv[0, 0, 1, 1::4] = math.nan, math.inf
    inside = ((uv >= 0) & (uv < 1)).all(2)
    found = aggregate(images, uv, masks, 8)
    assert float(found.hits.sum()) == int(inside.sum())
    assert all(torch.isfinite(value).all() for value in found)


@pytest.mark.parametrize("normalization", ["minmax", "max"])
@pytest.mark.parametrize("masked", [0.0, 1.0])
def test_35_confidence_of_nothing_and_of_uniform_counts(normalization: str, masked: float) -> None:
    centres = (torch.arange(SIDE) + 0.5) / SIDE
    uv = torch.stack([centres.expand(SIDE, SIDE), centres[:, None].expand(SIDE, SIDE)])[None, None]
    images, masks = torch.rand(1, 1, 3, SIDE, SIDE), torch.full((1, 1, 1, SIDE, SIDE), masked)
    found = aggregate(images, uv, masks, SIDE, normalization=normalization)
    assert torch.equal(found.confidence, torch.full_like(found.confidence, masked))


@given(seed=st.integers(0, 2**31), size=st.floats(-30, -2))
def test_36_triangles_without_area_have_frames(seed: int, size: float) -> None:
    g = torch.Generator().manual_seed(seed)
    corners = torch.randn(3, 3, generator=g)
    corners[2] = corners[0] + 10**size * (corners[1] - corners[0])
    rotation, area = surface_frames(corners.requires_grad_(), torch.tensor([[0, 1, 2]]))
    (rotation.sum() + area.sum()).backward()
    assert torch.isfinite(rotation).all() and torch.isfinite(area).all() and (area >= 0).all()
    assert corners.grad is not None and torch.isfinite(corners.grad).all()


@given(seed=st.integers(0, 2**31))
def test_37_extreme_faces_stay_gaussians(worst: Worst, seed: int) -> None:
    head = load_head()
    avatar = painted_avatar(head, 32)
    g = torch.Generator().manual_seed(seed)
    rest = HeadParameters.zeros(head)
    params = rest.replace(
        expression=5 * torch.randn(rest.expression.shape, generator=g).clamp(-1, 1),
        jaw=torch.tensor([math.radians(40), 0, 0]),
        rotation=torch.tensor([0, math.pi, 0]),
    )
    means, quats, scales = avatar.pose(params, head)
    assert all(torch.isfinite(value).all() for value in (means, quats, scales))
    assert worst("quaternion length off 1", float((quats.norm(dim=-1) - 1).abs().max())) < 1e-4
    ratio = scales / avatar.scales.clamp_min(1e-12)
    assert float(ratio.min()) > 0.49 and worst("growth", float(ratio.max())) < 2.01


@pytest.mark.parametrize("views", [1, 5, 64])
def test_38_order_and_repetition_of_views(worst: Worst, views: int) -> None:
    g = torch.Generator().manual_seed(views)
    images, uv = torch.rand(1, views, 3, SIDE, SIDE, generator=g), torch.rand(1, views, 2, SIDE, SIDE, generator=g)
    masks = torch.ones(1, views, 1, SIDE, SIDE)
    order = torch.randperm(views, generator=g)
    one = aggregate(images, uv, masks, 8)
    other = aggregate(images[:, order], uv[:, order], masks, 8)
    twice = aggregate(images.repeat(1, 2, 1, 1, 1), uv.repeat(1, 2, 1, 1, 1), masks.repeat(1, 2, 1, 1, 1), 8)
    assert worst("colour, other order", float((one.rgb - other.rgb).abs().max())) < 1e-6
    assert worst("colour, every view twice", float((one.rgb - twice.rgb).abs().max())) < 1e-6


@pytest.mark.parametrize("value", [0, 255])
def test_39_a_photo_of_nothing_is_read_and_has_no_face(value: int, tmp_path: Path) -> None:
    from uika.photo import prepare

    path = tmp_path / "flat.png"
    Image.new("RGB", (96, 96), (value,) * 3).save(path)
    assert (read(path).rgb == value).all()
    with pytest.raises(PhotoError, match=r"flat\.png"):
        prepare(path)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "I;16"])
def test_39_forty_eight_megapixels(mode: str, tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    if mode == "I;16":
        Image.fromarray(np.full((6000, 8000), 257, np.uint16)).save(path, compress_level=1)
    else:
        Image.new(mode, (8000, 6000)).save(path, compress_level=1)
    assert read(path).rgb.shape == (6000, 8000, 3)
