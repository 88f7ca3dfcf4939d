"""Refinement by colours trusts landmarks as far as their errors allow."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.fitting.landmarks import seen
from uika.fitting import fit_landmarks, fit_photos
from uika.fitting.landmark_prior import identity_modes, landmark_anchor, landmark_trust
from uika.fitting.landmarks import LandmarkFit, eye_distance
from uika.fitting.refinement import follow_known_face, refine_landmark_fit
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at, pose_vertices, project
from uika.head.axis_angle import rotation
from uika.head.face_paint import paint, shade
from uika.head.landmark_model import FrameModel, Pose, frame_model, moved, shifted

FOCAL = 1200.0
SIZE = 256
YAWS = (-35.0, 0.0, 35.0)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def turned(model: FrameModel) -> Pose:
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation(np.array([0.05, 0.3, 0.0]))
    return Pose(np.full(len(model.free), 0.1), np.zeros((0, 3, 3)), turn, np.array([0.0, 0.0, 1.1]))


def test_smooth_errors_earn_less_trust_than_noise(head: HeadModel) -> None:
    model = frame_model(head, torch.zeros(len(head.identity_basis)), FOCAL, eye_distance(head))
    pose, random = turned(model), np.random.default_rng(0)
    marks = seen(model, pose)
    noise = random.normal(size=marks.shape)
    place = marks / np.ptp(marks[model.ids], axis=0)
    smooth = np.stack((np.sin(9 * place[:, 1]), np.cos(8 * place[:, 0])), -1)
    errors = {"noise": noise, "smooth": smooth}
    trust = {name: landmark_trust(model, {0: pose}, {0: marks + error}) for name, error in errors.items()}
    assert trust["noise"] > 1
    assert trust["smooth"] < 0.1 * trust["noise"]
    half = landmark_trust(model, {0: pose}, {0: marks + noise / 2})
    assert half > 3 * trust["noise"]


def test_the_anchor_is_the_slope_of_the_landmark_error(head: HeadModel) -> None:
    model = frame_model(head, torch.zeros(len(head.identity_basis)), FOCAL, eye_distance(head))
    pose, count = turned(model), 12
    modes = identity_modes(head, model, count)
    target = seen(model, pose) + 1e-4 * np.random.default_rng(1).normal(size=(478, 2))
    matrix, _ = landmark_anchor(model, modes, pose, target)
    for index in (2, count + 1 + 5, len(matrix) - 5, len(matrix) - 1):
        step = np.zeros(len(matrix))
        step[index] = 1e-3
        other = shifted(model, np.asarray(modes @ step[:count], dtype=np.float64).T)
        # At a perfect fit the change of the gradient over a step is the matrix's column.
        met = landmark_anchor(model, modes, pose, seen(model, pose))[1]
        change = landmark_anchor(other, modes, moved(model, pose, step[count + 1 :]), seen(model, pose))[1] - met
        expected = matrix[:, index] * 1e-3
        assert np.abs(change - expected).max() < 0.03 * np.abs(expected).max()


def face_error(head: HeadModel, found: Tensor, truth: Tensor) -> float:
    """Mean distance of the neutral faces in mm, after the best similarity."""
    face = head.masks["face"] > 0.5
    a, b = ((head.template + torch.einsum("k,kvc->vc", i.float(), head.identity_basis))[face] for i in (found, truth))
    a, b = a - a.mean(0), b - b.mean(0)
    u, s, vt = torch.linalg.svd(a.T @ b)
    return float((a @ (u @ vt) * (s.sum() / a.square().sum()) - b).norm(dim=-1).mean()) * 1e3


@pytest.fixture(scope="module")
def photos(head: HeadModel) -> tuple[Tensor, list[Tensor], Tensor]:
    """A painted head from three sides: its identity, pictures and exact landmarks."""
    generator = torch.Generator().manual_seed(4)
    identity = 0.8 * torch.randn(len(head.identity_basis), generator=generator)
    vertices = pose_vertices(head, HeadParameters.zeros(head).replace(identity=identity))
    views = [look_at(yaw, 0.0, 1.0, (0.0, -0.01, 0.0), fov_y=20.0, size=SIZE) for yaw in YAWS]
    colours = paint(head)
    pictures = [torch.from_numpy(shade(vertices, head.faces, colours, view)[0]).float() / 255 for view in views]
    marks = torch.full((len(YAWS), 478, 2), SIZE / 2)
    marks[:, head.landmark_ids] = project(head.landmarks(vertices).expand(len(YAWS), -1, -1), Camera.stack(views))[0]
    return identity, [picture.permute(2, 0, 1) for picture in pictures], marks


def test_good_landmarks_are_not_spoiled(head: HeadModel, photos: tuple[Tensor, list[Tensor], Tensor]) -> None:
    identity, pictures, marks = photos
    noisy = marks + 0.7 * torch.randn(marks.shape, generator=torch.Generator().manual_seed(0))
    found = fit_landmarks(noisy, head, SIZE)
    refined, gain = refine_landmark_fit(found, pictures, noisy, head)
    assert gain is not None
    assert gain.after < gain.before
    assert face_error(head, refined.identity, identity) < 1.05 * face_error(head, found.identity, identity)


def test_one_photo_stays_as_it_is(head: HeadModel, photos: tuple[Tensor, list[Tensor], Tensor]) -> None:
    _, pictures, marks = photos
    found = fit_landmarks(marks[:1], head, SIZE)
    assert refine_landmark_fit(found, pictures[:1], marks[:1], head) == (found, None)


def test_a_new_photo_is_put_where_its_colours_are(head: HeadModel, photos: tuple[Tensor, list[Tensor], Tensor]) -> None:
    identity, pictures, marks = photos
    known = fit_landmarks(marks[1:], head, SIZE, identity)
    place = marks[:1] / SIZE - 0.5
    # A detector's errors are smooth: here it sees the face too high and its lower half too small.
    wrong = marks[:1] + 5 * torch.stack((0.3 * place[..., 1], 1.5 * place[..., 1].abs() - 0.5), -1)
    found = fit_landmarks(wrong, head, SIZE, identity)
    followed = follow_known_face(found, pictures[:1], wrong, head, known, pictures[1:], marks[1:])
    before, after = (face_pixels(head, each) - (marks[:1, head.landmark_ids] - SIZE / 2) for each in (found, followed))
    assert torch.equal(followed.identity, found.identity)
    assert after.norm(dim=-1).mean() < 0.5 * before.norm(dim=-1).mean()


def face_pixels(head: HeadModel, fit: LandmarkFit) -> Tensor:
    """Where the face's landmarks lie in each photo, [N,L,2] pixels from the principal point."""
    points, identity, expression = (
        head.landmarks(part).double() for part in (head.template, head.identity_basis, head.expression_basis)
    )
    points = points + torch.einsum("k,klc->lc", fit.identity, identity)
    points = points + torch.einsum("ne,elc->nlc", fit.expression, expression)
    camera = points @ fit.rotation.mT + fit.translation[:, None]
    return fit.focal[:, None, None] * camera[..., :2] / camera[..., 2:]


@dataclass
class Photo:
    landmarks: Tensor
    matte: Tensor


def test_a_known_fit_with_images_leads_new_photos(head: HeadModel, photos: tuple[Tensor, list[Tensor], Tensor]) -> None:
    _, pictures, marks = photos
    taken = [Photo(mark, torch.ones(SIZE, SIZE)) for mark in marks]
    known = fit_photos(taken[1:], head, images=pictures[1:])
    assert known.images is not None
    led = fit_photos(taken[:1], head, images=pictures[:1], known=known)
    alone = fit_photos(taken[:1], head, images=pictures[:1], known=replace(known, images=None))
    assert not torch.equal(led.cameras.viewmat, alone.cameras.viewmat)
    assert torch.equal(led.parameters.identity, alone.parameters.identity)
