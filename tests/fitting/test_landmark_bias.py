"""The detector's expected error is taken out in the head's own frame."""

import math

import pytest
import torch
from torch import Tensor

from uika.fitting import fit_landmarks, fit_photos
from uika.fitting.landmark_bias import detector_bias, unbiased, upright, view_polynomials
from uika.fitting.landmarks import LandmarkFit, eye_distance
from uika.head import Camera, HeadModel, load_head, look_at, project

SIZE = 512


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def seen(head: HeadModel, yaw: float) -> tuple[Tensor, Tensor, float]:
    """Exact landmarks [478,2] of the mean head, the rotation to the camera, and pixels of one eye-corner distance."""
    camera = look_at(yaw, 4.0, 1.1, fov_y=20.0, size=SIZE)
    marks = torch.full((478, 2), SIZE / 2)
    marks[head.landmark_ids] = project(head.landmarks(head.template), camera)[0]
    return marks, camera.viewmat[:3, :3].double(), float(camera.K[0, 0]) * eye_distance(head) / 1.1


def test_frontal_detections_stay_as_they_are(head: HeadModel) -> None:
    marks, _, unit = seen(head, 0.0)
    corrected = unbiased(marks[None], fit_landmarks(marks[None], head, SIZE), head)[0]
    assert float((corrected - marks).norm(dim=-1).mean()) < 0.01 * unit


@pytest.mark.parametrize("yaw", [-50.0, 35.0])
def test_a_biased_detection_is_set_right(head: HeadModel, yaw: float) -> None:
    marks, rotation, unit = seen(head, yaw)
    expected = torch.einsum("nf,flc->nlc", view_polynomials(-rotation[None, 2]), detector_bias())[0]
    wrong = marks + (unit * expected @ upright(rotation[None])[0]).float()
    corrected = unbiased(wrong[None], fit_landmarks(wrong[None], head, SIZE), head)[0]
    at = head.landmark_ids
    before, after = ((m - marks)[at].norm(dim=-1).mean() for m in (wrong, corrected))
    assert before > 0.01 * unit
    assert after < 0.3 * before


class Marks:
    """A photo of which nothing but landmarks is known."""

    def __init__(self, landmarks: Tensor) -> None:
        self.landmarks, self.matte = landmarks, torch.ones(SIZE, SIZE)


def test_several_photos_are_freed_from_it_and_then_agree(head: HeadModel) -> None:
    photos = []
    for yaw in (0.0, 40.0, -40.0):
        marks, rotation, unit = seen(head, yaw)
        error = torch.einsum("nf,flc->nlc", view_polynomials(-rotation[None, 2]), detector_bias())[0]
        photos.append(Marks(marks + (unit * error @ upright(rotation[None])[0]).float()))
    chosen, biased = fit_photos(photos, head), fit_photos(photos, head, correct_detector=False)

    def wrong_distance(cameras: Camera) -> float:
        return float((cameras.viewmat[:, 2, 3] / 1.1).log().abs().max())

    assert chosen.parameters.identity[0].norm() < 0.5 * biased.parameters.identity[0].norm()
    assert wrong_distance(chosen.cameras) < 0.5 * wrong_distance(biased.cameras)
    alone, as_found = (fit_photos(photos[1:2], head, correct_detector=way) for way in (None, False))
    assert torch.equal(alone.parameters.identity, as_found.parameters.identity)


def test_the_correction_turns_with_the_picture(head: HeadModel) -> None:
    marks, rotation, _ = seen(head, 30.0)
    angle = math.radians(40)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    roll = torch.eye(3).double()
    roll[:2, :2] = turn
    fits = [
        LandmarkFit(
            torch.zeros(1),
            torch.zeros(1, 1),
            r[None],
            torch.tensor([[0.0, 0.0, 1.1]]),
            torch.ones(1) * 1400,
            torch.zeros(1),
        )
        for r in (rotation, roll @ rotation)
    ]
    straight, rolled = (unbiased(marks[None], fit, head)[0] - marks for fit in fits)
    assert torch.allclose(straight @ turn.mT, rolled, atol=1e-3)
    assert float(straight.norm(dim=-1).max()) > 1.0
