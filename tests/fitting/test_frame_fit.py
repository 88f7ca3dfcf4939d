"""Frame-wise fitting finds pose, expression, jaw and eyes again; colours sharpen what landmarks miss."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.fitting.landmarks import seen
from tests.flame_files import flame_arrays
from uika.fitting.bundle_adjustment import bundle
from uika.fitting.frame_fit import fit_frame
from uika.fitting.landmarks import eye_distance
from uika.fitting.photometric import SIDE, FaceCrop, add_observation, fit_pose, make_appearance, place_points
from uika.head import HeadModel, load_head
from uika.head.axis_angle import Array, axis_angle, rotation
from uika.head.landmark_model import FrameModel, Pose, frame_model, head_landmarks, landmark_jacobian, moved
from uika.head_import.flame_file import read_flame

FOCAL = 1200.0
FRONT = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def rest(model: FrameModel) -> Pose:
    still = np.tile(np.eye(3), (len(model.joints), 1, 1))
    return Pose(np.zeros(len(model.free)), still, FRONT, np.array([0.0, 0.0, 1.1]))


def degrees(one: Array, other: Array) -> float:
    return float(np.degrees(np.linalg.norm(axis_angle(one @ other.T))))


def person(head: HeadModel, seed: int = 0) -> torch.Tensor:
    return 0.8 * torch.randn(len(head.identity_basis), generator=torch.Generator().manual_seed(seed))


def test_pose_and_actions_are_found_again(head: HeadModel) -> None:
    model = frame_model(head, person(head), FOCAL, eye_distance(head))
    names = head.expression_names
    true = replace(rest(model), rotation=rotation(np.array([0.1, 0.3, -0.1])) @ FRONT)
    for name, amount in (("jawOpen", 0.5), ("mouthSmileLeft", 0.6), ("eyeBlinkRight", 0.9), ("browInnerUp", 0.5)):
        true.expression[names.index(name)] = amount
    pose, error = rest(model), 1.0
    for _ in range(4):
        pose, error = fit_frame(model, seen(model, true), pose)
    assert error < 0.002
    assert degrees(pose.rotation, true.rotation) < 0.2
    assert np.abs(pose.expression - true.expression).max() < 0.15
    assert pose.expression.min() >= 0
    assert pose.expression.max() <= 1
    assert pose.expression[names.index("tongueOut")] == 0


def test_jaw_and_eyes_turn_where_no_action_stands_for_them(tmp_path, head: HeadModel) -> None:
    np.savez(tmp_path / "model.npz", **flame_arrays())
    flame = read_flame(tmp_path / "model.npz")
    marks = {"landmark_ids": head.landmark_ids, "landmark_weights": head.landmark_weights}
    from uika.head_import.landmark_embedding import nearest

    triangle, mix, _ = nearest(head.landmarks(head.template), flame.template, flame.faces)
    flame = replace(flame, landmark_faces=triangle, landmark_barycentrics=mix, **marks)
    model = frame_model(flame, torch.zeros(300), FOCAL, eye_distance(flame))
    turns = [rotation(np.array(v)) for v in ([0.25, 0.0, 0.0], [0.1, 0.2, 0.0], [0.1, 0.2, 0.0])]
    true = replace(rest(model), joints=np.array(turns))
    pose = rest(model)
    for _ in range(4):
        pose, error = fit_frame(model, seen(model, true), pose)
    assert error < 0.003
    for found, turn in zip(pose.joints, turns, strict=True):
        assert degrees(found, turn) < 3.0


def test_landmark_derivatives_are_exact(head: HeadModel) -> None:
    model = frame_model(head, person(head), FOCAL, eye_distance(head))
    pose = replace(rest(model), expression=np.full(len(model.free), 0.2))
    step = np.zeros(len(model.free) + 6)
    step[3] = 1e-5
    change = (head_landmarks(model, moved(model, pose, step)) - head_landmarks(model, pose)) / 1e-5
    np.testing.assert_allclose(change, landmark_jacobian(model, pose)[..., 3], atol=1e-6)


def painted(points: Array, level: Array, focal: float) -> FaceCrop:
    """A picture in which a wavy pattern is painted at crop pixels `points`."""
    from scipy.interpolate import griddata

    grid = np.stack(np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5), -1)
    image = griddata(points, level, grid, fill_value=0.5).astype(np.float32)
    down, across = np.gradient(image)
    return FaceCrop(np.stack((image, across, down), -1).reshape(-1, 3), np.array([-SIDE / 2, -SIDE / 2]), 1.0)


def views_of(
    head: HeadModel, identity: torch.Tensor, turns: list[float]
) -> tuple[dict[int, FaceCrop], dict[int, Pose]]:
    """Pictures of a person with a pattern on the skin, and the poses they show."""
    model = make_appearance(head, identity, FOCAL, eye_distance(head)).model
    place = model.points[0] / 0.004
    level = 0.5 + 0.2 * np.sin(place[:, 0] * 1.1 + 0.4 * place[:, 1]) * np.cos(place[:, 1] * 0.9 - 0.3 * place[:, 2])
    blank = FaceCrop(np.zeros((SIDE * SIDE, 3), np.float32), np.array([-SIDE / 2, -SIDE / 2]), 1.0)
    views, poses = {}, {}
    for index, turn in enumerate(turns):
        pose = replace(rest(model), rotation=FRONT @ rotation(np.array([0.05 * index, turn, 0.0])))
        spot, camera = place_points(model, pose, blank)
        facing = -((model.normal @ pose.rotation.T) * camera).sum(-1) / np.linalg.norm(camera, axis=-1) > 0.1
        views[index] = painted(spot[facing], level[facing], FOCAL)
        poses[index] = pose
    return views, poses


def test_colours_correct_a_wrong_guess(head: HeadModel) -> None:
    identity = person(head)
    views, poses = views_of(head, identity, [0.0, 0.1])
    known = add_observation(make_appearance(head, identity, FOCAL, eye_distance(head)), poses[0], views[0])
    wrong = replace(poses[1], rotation=rotation(np.array([0.02, -0.02, 0.01])) @ poses[1].rotation)
    P = len(known.model.free) + 6
    free = (np.zeros((P, P)), np.zeros(P))
    found, error = fit_pose(known, [(views[1], 12)], wrong, poses[0], free)
    assert degrees(found.rotation, poses[1].rotation) < 0.25 * degrees(wrong.rotation, poses[1].rotation)
    assert error < 0.03


def test_shared_colours_sharpen_the_identity(head: HeadModel) -> None:
    identity = person(head)
    views, poses = views_of(head, identity, [-0.5, -0.25, 0.0, 0.25, 0.5])
    unit = eye_distance(head)
    true = frame_model(head, identity, FOCAL, unit)
    targets = {index: seen(true, pose) for index, pose in poses.items()}
    guess = torch.zeros_like(identity)
    blank, model = make_appearance(head, guess, FOCAL, unit), frame_model(head, guess, FOCAL, unit)
    found = bundle(head, blank, model, poses, views, targets, 1e-4)
    assert found.costs[1] < 0.7 * found.costs[0]
    sharper = guess.clone()
    sharper[: len(found.offset)] += torch.from_numpy(found.offset).float()

    def distance(one: torch.Tensor) -> float:
        face = head.masks["face"] > 0.5
        a, b = ((head.template + torch.einsum("k,kvc->vc", i, head.identity_basis))[face] for i in (one, identity))
        a, b = a - a.mean(0), b - b.mean(0)
        u, s, vt = torch.linalg.svd(a.T @ b)
        return float((a @ (u @ vt) * (s.sum() / a.square().sum()) - b).norm(dim=-1).mean())

    assert distance(sharper) < 0.8 * distance(guess)
