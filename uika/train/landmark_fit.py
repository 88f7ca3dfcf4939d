"""A landmark fit to photos whose landmarks are known, with errors as a detector makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from uika.data.views import View
from uika.fitting import Fit, fit_photos
from uika.head import HeadModel, pose_vertices, project
from uika.train.truth import offset_of, parameters_of

_LANDMARK_BIAS, _LANDMARK_NOISE = 0.012, 0.008  # of a simulated detector, in widths of the face
_FACE_MESH_POINTS = 478


def fit_landmarks_with_errors(photos: list[View], masks: Tensor, head: HeadModel, random: np.random.Generator) -> Fit:
    """What the landmark fit makes of the photos, with landmarks as a detector might find them."""
    found = []
    for view, mask in zip(photos, masks, strict=True):
        vertices = pose_vertices(head, parameters_of(view), offset_of(view, head))
        pixels, _ = project(head.landmarks(vertices), view.camera)
        width = pixels[:, 0].max() - pixels[:, 0].min()
        bias = _LANDMARK_BIAS * _smooth_noise(head, random)
        noise = torch.from_numpy(random.normal(0, _LANDMARK_NOISE, (len(pixels), 2))).float()
        landmarks = torch.zeros(_FACE_MESH_POINTS, 2)
        landmarks[head.landmark_ids] = pixels + width * (bias + noise)
        found.append(_Photo(landmarks, mask))
    return fit_photos(found, head, [photo.matte for photo in found], correct_detector=False)


@dataclass(frozen=True, eq=False)
class _Photo:
    landmarks: Tensor
    matte: Tensor


def _smooth_noise(head: HeadModel, random: np.random.Generator) -> Tensor:
    """Errors [L,2] of deviation 1 that neighbouring landmarks share."""
    place = head.landmarks(head.template) / 0.05  # wavelengths of a face's features
    waves = torch.from_numpy(random.normal(size=(4, 3))).float()
    phases = torch.from_numpy(random.uniform(0, 2 * np.pi, 4)).float()
    mixture = torch.from_numpy(random.normal(size=(4, 2))).float()
    return torch.cos(place @ waves.mT + phases) @ mixture * (2 / 4) ** 0.5
