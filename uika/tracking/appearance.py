"""The person's appearance, learned from key frames of a video, then fitted to all frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uika.fitting.frame_fit import landmark_pull
from uika.fitting.photometric import Appearance, FaceCrop, add_observation, crop_face, fit_pose
from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose

BLURS = ((2.5, 3), (0.8, 3))  # pixels of the face crop, and steps at that blur
LANDMARK_PULL = 0.01  # landmarks only keep the colours from getting lost: their errors are systematic
FIRST_STEPS, SECOND_STEPS = 8, 6  # for key frames


def learn_appearance(
    blank: Appearance, model: FrameModel, rough: dict[int, Pose], targets: dict[int, Array], keys: dict[int, FaceCrop]
) -> tuple[Appearance, dict[int, Pose]]:
    """The person's colours: from the calmest frontal key frame first, then from all, each fitted to what is known.

    Returns:
        The colours and the poses of the key frames.
    """
    expressions = np.stack([rough[index].expression for index in keys])
    odd = np.abs(expressions - np.median(expressions, 0)).sum(1)
    turned = np.degrees(np.arccos(np.array([-rough[index].rotation[2, 2] for index in keys]).clip(-1, 1)))
    first = list(keys)[int(np.argmin(turned / 10 + odd))]
    order = sorted(keys, key=lambda index: float(np.linalg.norm(rough[index].rotation - rough[first].rotation)))
    person = add_observation(blank, rough[first], keys[first])
    poses: dict[int, Pose] = {}
    for index in order:
        pull = _pull(model, rough[index], targets[index])
        poses[index], _ = fit_pose(person, [(keys[index], FIRST_STEPS)], rough[index], rough[first], pull)
        person = add_observation(person, poses[index], keys[index])
    renewed = blank
    for index in order:
        pull = _pull(model, poses[index], targets[index])
        poses[index], _ = fit_pose(person, [(keys[index], SECOND_STEPS)], poses[index], poses[index], pull)
        renewed = add_observation(renewed, poses[index], keys[index])
    return renewed, poses


def _pull(model: FrameModel, pose: Pose, target: Array) -> tuple[Array, Array]:
    matrix, gradient = landmark_pull(model, pose, target)
    return LANDMARK_PULL * matrix, LANDMARK_PULL * gradient


def track_appearance(
    person: Appearance,
    model: FrameModel,
    rough: dict[int, Pose],
    targets: dict[int, Array],
    greys: Iterator[NDArray[np.uint8]],
    centre: Array,
) -> dict[int, Pose]:
    """The pose of each frame with landmarks.

    Args:
        person: the colours.
        model: the person's landmarks.
        rough: poses by landmarks, by frame.
        targets: landmarks [478,2] relative to the principal point, by frame.
        greys: all frames [H,W].
        centre: [2] principal point.
    """
    poses: dict[int, Pose] = {}
    for index, grey in enumerate(greys):
        if index not in targets:
            continue
        marks = targets[index] + centre
        views = [(crop_face(grey, marks, centre, blur), steps) for blur, steps in BLURS]
        guess = before = rough[index]
        if index - 1 in poses:
            # The landmarks' errors cancel in their change from frame to frame.
            before, was = poses[index - 1], rough[index - 1]
            turn = rough[index].rotation @ was.rotation.T
            shift = rough[index].translation - was.translation
            guess = replace(before, rotation=turn @ before.rotation, translation=before.translation + shift)
        poses[index], _ = fit_pose(person, views, guess, before, _pull(model, guess, targets[index]))
    return poses
