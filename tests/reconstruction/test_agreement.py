"""Photos of different people are spoken of."""

import math
import warnings

import pytest
import torch

from uika.errors import UikaWarning
from uika.fitting import Fit, pixel_uv
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at
from uika.reconstruction.agreement import (
    ALIKE,
    FaceDrawing,
    agreement,
    best_agreements,
    face_drawings,
    warn_of_strangers,
)

SIZE = 192


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def drawing(head: HeadModel, seed: int, yaw: float, gain: float = 1.0) -> FaceDrawing:
    """A face with random features, which the seed tells, seen from a side in a light of its own."""
    camera = Camera.stack([look_at(yaw, 0.0, 1.0, fov_y=16.0, size=SIZE)])
    fit = Fit(HeadParameters.zeros(head, 1), camera, torch.zeros_like(head.template), torch.zeros(1))
    uv, valid, weight = pixel_uv(fit, head, torch.ones(1, SIZE, SIZE))
    texture = torch.rand(1, 1, 40, 40, generator=torch.Generator().manual_seed(seed))
    place = 2 * uv - 1
    shown = torch.nn.functional.grid_sample(texture, place, align_corners=False)[0]
    shade = gain * torch.linspace(0.6, 1.0, SIZE)
    noise = 0.05 * torch.randn(SIZE, SIZE, generator=torch.Generator().manual_seed(99 + seed + int(yaw)))
    image = ((0.3 + 0.4 * shown) * shade + noise).expand(3, -1, -1)
    found = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)
    return face_drawings(head, image[None], found, weight)[0]


def test_one_person_agrees_across_views_and_lights_and_others_do_not(head: HeadModel) -> None:
    front, side, other = drawing(head, 1, 0.0), drawing(head, 1, 35.0, 0.6), drawing(head, 2, 0.0)
    assert agreement(front, side) > ALIKE + 0.1
    assert agreement(front, other) < ALIKE - 0.2
    best = best_agreements([front, side, other])
    assert best[0] == best[1] == pytest.approx(agreement(front, side)) and best[2] < ALIKE
    nothing = FaceDrawing(torch.zeros_like(front.detail), torch.zeros_like(front.known))
    assert math.isnan(best_agreements([front, nothing])[0]) and math.isnan(best_agreements([front])[0])


class _Named:
    def __init__(self, path: str) -> None:
        self.path = path


def test_the_photos_are_named() -> None:
    photos = [_Named("a.jpg"), _Named("b.jpg"), _Named("c.jpg")]
    with pytest.warns(UikaWarning, match=r"^c\.jpg: shows a face unlike"):
        warn_of_strangers(photos, [0.8, 0.8, 0.3])  # type: ignore[arg-type]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_strangers(photos, [0.8, math.nan, 0.7])  # type: ignore[arg-type]
        warn_of_strangers(photos, [])
