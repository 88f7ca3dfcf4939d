import numpy as np
import pytest
import torch
from PIL import Image

from uika.assets import PORTRAIT
from uika.head import HeadParameters, load_head, look_at, pose_vertices, project
from uika.metrics import expression_distance, fit_faces, keypoint_distance, pose_distance
from uika.metrics.faces import FaceFit, find_landmarks

SIZE = 256


def face(jaw: float = 0.0, yaw: float = 0.0) -> torch.Tensor:
    """Landmarks [478,2] of a face that opens its mouth and turns its head by `yaw` radians."""
    head = load_head().without_bust
    random = torch.Generator().manual_seed(3)
    expression = torch.zeros(len(head.expression_names))
    expression[head.expression_names.index("jawOpen")] = jaw
    expression[head.expression_names.index("mouthSmileLeft")] = 0.3
    params = HeadParameters.zeros(head).replace(
        identity=0.5 * torch.randn(len(head.identity_basis), generator=random),
        expression=expression,
        rotation=torch.tensor([0.0, yaw, 0.0]),
    )
    pixels, _ = project(head.landmarks(pose_vertices(head, params)), look_at(size=SIZE, target=(0.0, 0.0, 0.0)))
    points = torch.zeros(478, 2)
    points[head.landmark_ids] = pixels
    return points


def distances(first: torch.Tensor, second: torch.Tensor) -> tuple[float, float, float]:
    head = load_head().without_bust
    fits = [fit_faces(points[None], head, SIZE) for points in (first, second)]
    points = keypoint_distance(first[None], second[None], SIZE)
    return float(expression_distance(*fits)), float(pose_distance(*fits)), float(points)


def test_equal_faces_have_no_distance() -> None:
    assert distances(face(0.3, 0.2), face(0.3, 0.2)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_distances_rise_with_the_expression() -> None:
    found = [distances(face(), face(jaw=jaw)) for jaw in (0.1, 0.3, 0.6)]
    assert [aed for aed, _, _ in found] == sorted(aed for aed, _, _ in found)
    assert [akd for _, _, akd in found] == sorted(akd for _, _, akd in found)
    # One of the activations changes; the fit spreads it over those that look alike.
    one = 1 / len(load_head().without_bust.expression_names)
    assert 0.3 * 0.6 * one < found[2][0] < 4 * 0.6 * one
    assert max(apd for _, apd, _ in found) < 0.05


def test_distances_rise_with_the_pose() -> None:
    found = [distances(face(), face(yaw=yaw)) for yaw in (0.05, 0.15, 0.4)]
    for (_, apd, _), yaw in zip(found, (0.05, 0.15, 0.4), strict=True):
        assert apd == pytest.approx(yaw, rel=0.25)
    assert [akd for _, _, akd in found] == sorted(akd for _, _, akd in found)


def test_pose_distance_is_the_angle() -> None:
    turns = torch.tensor([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 3.0]], dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(
        torch.stack([torch.linalg.cross(turns, axis.expand_as(turns)) for axis in torch.eye(3).double()], -1)
    )
    fits = FaceFit(torch.zeros(4, 1), rotation)
    still = FaceFit(torch.zeros(4, 1), torch.eye(3).double().expand(4, 3, 3))
    torch.testing.assert_close(pose_distance(fits, still), turns.norm(dim=-1), atol=1e-9, rtol=1e-6)


def test_keypoint_distance_is_given_for_512_pixels() -> None:
    points = face()
    moved = points + torch.tensor([3.0, 4.0])
    assert float(keypoint_distance(points[None], moved[None], SIZE)) == pytest.approx(5.0 * 512 / SIZE, rel=1e-5)


def test_a_shifted_photo_has_shifted_landmarks() -> None:
    pixels = np.asarray(Image.open(PORTRAIT).convert("RGB"))
    photo = torch.from_numpy(pixels.astype(np.float32) / 255)
    first, second = find_landmarks(photo), find_landmarks(photo.roll(8, dims=1))
    assert first is not None and second is not None
    shift = (second - first).mean(0)
    np.testing.assert_allclose(shift, [8.0, 0.0], atol=1.0)
    again = find_landmarks(photo)
    assert again is not None and bool((again == first).all())
    assert find_landmarks(torch.full((64, 64, 3), 0.5)) is None
