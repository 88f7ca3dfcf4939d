"""Landmarks as a perfect detector would find them."""

import numpy as np

from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose, head_landmarks


def seen(model: FrameModel, pose: Pose) -> Array:
    """Pixels [478,2] of the model's landmarks in a pose, relative to the principal point; 0 for all others."""
    camera = head_landmarks(model, pose) @ pose.rotation.T + pose.translation
    marks = np.zeros((478, 2))
    marks[model.ids] = model.focal * camera[:, :2] / camera[:, 2:]
    return marks
