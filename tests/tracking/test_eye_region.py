"""Lids, gaze and brows keep their full range."""

from dataclasses import replace

import numpy as np
import torch

from uika.fitting.landmarks import eye_distance
from uika.head import HeadModel, load_head
from uika.head.landmark_model import FrameModel, Pose, frame_model, head_landmarks
from uika.tracking.eye_region import full_range

FRAMES = 60
ACTIONS = ("eyeBlinkLeft", "eyeBlinkRight", "eyeLookOutLeft", "eyeLookInRight", "eyeLookInLeft", "browInnerUp")


def person() -> tuple[HeadModel, FrameModel]:
    head = load_head()
    return head, frame_model(head, torch.zeros(len(head.identity_basis)), 900.0, eye_distance(head))


def acted(head: HeadModel, share: float) -> dict[int, Pose]:
    """Blinks, glances and lifted brows of a head that turns; `share` of them."""
    flip, poses = np.diag([1.0, -1.0, -1.0]), {}
    for index in range(FRAMES):
        expression = np.zeros(len(head.expression_names))
        phase = 2 * np.pi * index / FRAMES
        left, right = max(0.8 * np.sin(phase), 0), max(-0.8 * np.sin(phase), 0)
        blink = max(1 - abs(index % 20 - 10) / 4, 0.0)
        levels = (blink, blink, left, left, right, 0.5 - 0.5 * np.cos(phase))
        for name, level in zip(ACTIONS, levels, strict=True):
            expression[head.expression_names.index(name)] = share * float(level)
        yaw = 0.3 * np.cos(phase)
        turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        poses[index] = Pose(expression, np.zeros((0, 3, 3)), flip @ turn, np.array([0.0, 0.0, 1.0]))
    return poses


def marks(model: FrameModel, poses: dict[int, Pose], bias: np.ndarray) -> dict[int, np.ndarray]:
    result = {}
    for index, pose in poses.items():
        camera = head_landmarks(model, pose) @ pose.rotation.T + pose.translation
        result[index] = np.zeros((478, 2))
        result[index][model.ids] = model.focal * camera[:, :2] / camera[:, 2:]
        result[index] += bias
    return result


def track(head: HeadModel, poses: dict[int, Pose], name: str) -> np.ndarray:
    return np.array([poses[index].expression[head.expression_names.index(name)] for index in sorted(poses)])


def test_damped_movements_come_back_in_spite_of_the_detectors_bias() -> None:
    head, model = person()
    true, damped = acted(head, 0.9), acted(head, 0.45)
    bias = np.random.default_rng(0).normal(0, 0.4, (478, 2))
    found = full_range(model, head.expression_names, damped, marks(model, true, bias))
    for name in ACTIONS:
        wanted, got = track(head, true, name), track(head, found, name)
        assert np.corrcoef(wanted, got)[0, 1] > 0.9, name
        assert np.ptp(got) > 0.8 * np.ptp(wanted), name
    other = head.expression_names.index("jawOpen")
    assert all(found[index].expression[other] == damped[index].expression[other] for index in found)


def test_what_was_right_stays() -> None:
    head, model = person()
    true = acted(head, 0.9)
    found = full_range(model, head.expression_names, true, marks(model, true, np.zeros((478, 2))))
    assert max(np.abs(found[index].expression - true[index].expression).max() for index in true) < 0.12


def test_short_clips_and_faces_from_the_side_are_left_alone() -> None:
    head, model = person()
    damped = acted(head, 0.4)
    targets = marks(model, acted(head, 0.9), np.zeros((478, 2)))
    few = {index: damped[index] for index in range(5)}
    assert full_range(model, head.expression_names, few, targets) is few
    side = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    turned = {index: replace(pose, rotation=pose.rotation @ side) for index, pose in damped.items()}
    found = full_range(model, head.expression_names, turned, targets)
    assert all(found[index] is turned[index] for index in turned)
