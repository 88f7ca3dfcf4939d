"""What of a person is head and hair."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from uika.photo import Photo, head_matte
from uika.photo.crop import pixel_centres
from uika.photo.outline import JAW, face_frame


def beside_the_jaw(photo: Photo, across: float, above: float, radius: float) -> Tensor:
    """A disc [S,S] at a place in face heights beside the face's right edge and above the chin."""
    size = photo.matte.shape[-1]
    points = photo.landmarks.double().numpy()
    x, y = face_frame(points, pixel_centres(size))
    edge = face_frame(points, points[list(JAW)])[0].max()
    return torch.from_numpy(np.hypot(x - edge - across, y - above) < radius)


def with_something(photo: Photo, where: Tensor, color: Tensor) -> Photo:
    noise = 0.015 * torch.randn(3, *where.shape, generator=torch.Generator().manual_seed(0))
    original = torch.where(where, (color[:, None, None] + noise).clamp(0, 1), photo.original)
    return replace(photo, original=original, matte=torch.where(where, 1.0, photo.matte))


@pytest.fixture(scope="module")
def skin(portrait: Photo) -> Tensor:
    column, row = portrait.landmarks[[50, 280, 9]].long().T
    return portrait.original[:, row, column].mean(1)


def test_a_hand_beside_the_jaw_is_no_hair(portrait: Photo, skin: Tensor) -> None:
    hand = beside_the_jaw(portrait, 0.2, 0.02, 0.12)
    assert head_matte(with_something(portrait, hand, skin))[hand].mean() < 0.1


def test_hair_in_the_same_place_is(portrait: Photo) -> None:
    crown = portrait.landmarks[10].long() - torch.tensor([0, 60])
    hair = portrait.original[:, crown[1] - 4 : crown[1] + 4, crown[0] - 4 : crown[0] + 4].mean((1, 2))
    lock = beside_the_jaw(portrait, 0.1, 0.25, 0.22)
    assert head_matte(with_something(portrait, lock, hair))[lock].mean() > 0.4


def test_what_hangs_together_with_nothing_is_left_out(portrait: Photo) -> None:
    island = beside_the_jaw(portrait, 0.75, 0.9, 0.12)
    wall = beside_the_jaw(portrait, 0.75, 0.9, 0.2)
    alone = with_something(portrait, island, torch.tensor([0.3, 0.2, 0.1]))
    alone = replace(alone, matte=torch.where(wall & ~island, 0.0, alone.matte))
    assert head_matte(alone)[island].max() == 0.0
