"""How faces differ in expression, pose and landmarks, all from the pictures alone."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from uika.head import HeadModel

KEYPOINT_SIDE = 512  # pixels, of the picture that keypoint distances are given for


class FaceFit(NamedTuple):
    """N fitted faces."""

    expression: Tensor  # [N,E] activations
    rotation: Tensor  # [N,3,3] head to camera


def find_landmarks(image: Tensor) -> Tensor | None:
    """Face mesh landmarks [478,2] in pixels of the largest face in a picture [H,W,3] in [0,1]; None without a face."""
    from uika.io.video import to_bytes
    from uika.photo.detect import find_face

    found = find_face(np.ascontiguousarray(to_bytes(image)))
    return None if found is None else torch.from_numpy(found)


def fit_faces(landmarks: Tensor, head: HeadModel, size: int) -> FaceFit:
    """Fit the head to landmarks [N,478,2] (pixels of square pictures of `size`) of one person in N pictures.

    Raises:
        ValueError: the landmarks have another shape or are not finite.
    """
    from uika.fitting.landmarks import fit_landmarks

    fit = fit_landmarks(landmarks, head, size)
    return FaceFit(fit.expression, fit.rotation)


def expression_distance(first: FaceFit, second: FaceFit) -> Tensor:
    """Mean absolute difference [N] of the activations, whose range is [0,1]."""
    return (first.expression - second.expression).abs().mean(-1)


def pose_distance(first: FaceFit, second: FaceFit) -> Tensor:
    """Angle [N] in radians between the heads' rotations."""
    # The chord of the angle: exact for small angles, where the arc cosine of the trace is not.
    chord = (first.rotation - second.rotation).flatten(-2).norm(dim=-1) / (2 * math.sqrt(2))
    return 2 * torch.asin(chord.clamp(max=1))


def keypoint_distance(first: Tensor, second: Tensor, size: int) -> Tensor:
    """Mean distance [N] of landmarks [N,478,2] of pictures of `size`, in pixels of a picture of 512 pixels."""
    return (first.double() - second.double()).norm(dim=-1).mean(-1) * (KEYPOINT_SIDE / size)
