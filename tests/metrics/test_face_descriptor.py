"""The free face descriptor: the numbers of the program that its weights come from, and near and far faces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from uika.assets import PORTRAIT
from uika.metrics.face_descriptor import face_descriptor, face_distance
from uika.metrics.faces import find_landmarks

# The first numbers that face-api 1.7.15 (tfjs) gives for the portrait's aligned face.
PEER = [
    -0.078709,
    0.039276,
    0.013202,
    -0.065119,
    -0.17706,
    -0.022747,
    -0.040951,
    -0.13694,
    0.10099,
    -0.110787,
    0.17921,
    -0.040917,
]


@pytest.fixture(scope="module")
def portrait() -> tuple[torch.Tensor, torch.Tensor]:
    image = torch.from_numpy(np.array(Image.open(PORTRAIT).convert("RGB"))).float() / 255
    return image, _marks(image)


def _marks(image: torch.Tensor) -> torch.Tensor:
    found = find_landmarks(image)
    assert found is not None
    return found


def test_it_says_what_its_origin_says(portrait):
    descriptor = face_descriptor(*portrait)
    assert descriptor.shape == (128,)
    assert (descriptor[: len(PEER)] - torch.tensor(PEER)).abs().max() < 1e-3


def test_the_same_face_is_near(portrait):
    image, marks = portrait
    mirrored = image.flip(1)
    assert face_distance(portrait, (mirrored, _marks(mirrored))) < 0.3
    assert face_distance(portrait, ((0.6 * image + 0.1), marks)) < 0.2
    turned = image.rot90(1)
    moved = torch.stack((marks[:, 1], image.shape[1] - marks[:, 0]), -1)
    assert face_distance(portrait, (turned, moved)) < 0.05


def test_another_face_is_farther_than_any_handling_of_the_same(portrait):
    """Other proportions are another person: the picture squeezed, and its landmarks with it."""
    image, marks = portrait
    narrow = torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], scale_factor=(1.0, 0.6))
    assert face_distance(portrait, (narrow[0].permute(1, 2, 0), marks * torch.tensor([0.6, 1.0]))) > 0.4
