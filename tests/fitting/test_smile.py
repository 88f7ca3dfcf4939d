"""A photo's smile is taken for one: it does not stay in the neutral face."""

import pytest
import torch
from torch import Tensor

from uika.fitting.landmarks import fit_landmarks
from uika.head import HeadModel, HeadParameters, load_head, pose_vertices, shaped_vertices
from uika.motion.presets import expression_vector

SIZE, FOCAL, DISTANCE = 512, 1200.0, 1.1
CORNERS, MIDDLE = (61, 291), (13, 14)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def marks(head: HeadModel, identity: Tensor, actions: dict[str, float], noise: Tensor) -> Tensor:
    """Landmarks [1,478,2] of a face before a camera, pixels."""
    expression = expression_vector(head, actions) if actions else torch.zeros(len(head.expression_names))
    points = head.landmarks(
        pose_vertices(head, HeadParameters.zeros(head).replace(identity=identity, expression=expression))
    )
    found = torch.full((478, 2), SIZE / 2)
    flat = torch.stack((points[:, 0], -points[:, 1]), -1) * FOCAL / (DISTANCE - points[:, 2:])
    found[head.landmark_ids] = flat + SIZE / 2 + noise
    return found[None]


def mouth(head: HeadModel, identity: Tensor) -> tuple[float, float]:
    """Width of the resting mouth and height of its corners over the lips' middle, millimetres."""
    points = head.landmarks(shaped_vertices(head, HeadParameters.zeros(head).replace(identity=identity)))
    at = [int((head.landmark_ids == k).nonzero()[0]) for k in (*CORNERS, *MIDDLE)]
    right, left, upper, lower = points[at] * 1000
    return float((right - left).norm()), float((right + left - upper - lower)[1] / 2)


@pytest.mark.parametrize(
    "actions",
    [
        {"mouthSmile": 0.8, "cheekSquint": 0.3, "mouthUpperUp": 0.3},
        {"mouthSmile": 1.0, "mouthStretch": 0.3, "mouthUpperUp": 0.5, "mouthLowerDown": 0.5},
        {"jawOpen": 0.7},
    ],
)
def test_the_neutral_mouth_rests(head: HeadModel, actions: dict[str, float]) -> None:
    random = torch.Generator().manual_seed(3)
    identity = 0.8 * torch.randn(len(head.identity_basis), generator=random)
    identity[64:] = 0
    noise = 0.5 * torch.randn(len(head.landmark_ids), 2, generator=random)
    resting, acting = (fit_landmarks(marks(head, identity, way, noise), head, SIZE) for way in ({}, actions))
    wide, high = mouth(head, resting.identity.float())
    wide_now, high_now = mouth(head, acting.identity.float())
    assert abs(wide_now / wide - 1) < 0.04
    assert abs(high_now - high) < 0.6
    found = dict(zip(head.expression_names, acting.expression[0].tolist(), strict=True))
    first = next(iter(actions))
    assert found.get(first, found.get(first + "Left", 0.0)) > 0.5 * actions[first]
