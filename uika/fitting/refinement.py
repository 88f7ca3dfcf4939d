"""Analysis by synthesis for photos: the same skin must look alike in all of them, once identity and poses are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from uika.fitting.bundle_adjustment import bundle
from uika.fitting.frame_fit import landmark_pull
from uika.fitting.landmark_prior import landmark_trust
from uika.fitting.landmarks import LandmarkFit, eye_distance
from uika.fitting.photometric import FaceCrop, add_observation, crop_face, fit_pose, make_appearance
from uika.head import HeadModel
from uika.head.axis_angle import Array
from uika.head.landmark_model import Pose, frame_model

BLUR = 0.8  # pixels of the face crop
FOLLOW_STEPS = 6
_LUMA = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class Gain:
    """What the refinement gained: its cost before and after, and how far the identity moved, in standard deviations."""

    before: float
    after: float
    moved: float

    def __str__(self) -> str:
        """One line for a report."""
        return f"colour mismatch {self.before:.0f} -> {self.after:.0f}, identity moved by {self.moved:.1f} sigma"


def refine_landmark_fit(
    fit: LandmarkFit, images: Sequence[Tensor], landmarks: Tensor, head: HeadModel
) -> tuple[LandmarkFit, Gain | None]:
    """Refine identity, expressions and poses with the photos' colours.

    Args:
        fit: the landmark fit of N photos.
        images: [3,S,S] each, sRGB in [0,1].
        landmarks: [N,478,2] pixels, for the pull that keeps the face in place.
        head: the head model.

    Returns:
        The refined fit and its gain; the same fit and None for a single photo, whose colours say nothing about shape,
        and for heads whose jaw and eyes are joints, which a landmark fit leaves at rest.
    """
    # One nominal focal length for all: a photo taken with another is the same view, scaled.
    nominal, unit = float(fit.focal.median()), eye_distance(head)
    model = frame_model(head, fit.identity, nominal, unit)
    if len(images) < 2 or model.joints:
        return fit, None
    person = make_appearance(head, fit.identity, nominal, unit)
    views: dict[int, FaceCrop] = {}
    targets: dict[int, Array] = {}
    poses: dict[int, Pose] = {}
    for n, image in enumerate(images):
        grey = (torch.einsum("chw,c->hw", image, image.new_tensor(_LUMA)) * 255).round().byte().numpy()
        marks, centre = landmarks[n].double().numpy(), np.array([image.shape[2], image.shape[1]]) / 2
        scale = nominal / float(fit.focal[n])
        view = crop_face(grey, marks, centre, BLUR)
        views[n] = replace(view, corner=view.corner * scale, scale=view.scale / scale)
        targets[n] = (marks - centre) * scale
        expression = fit.expression[n].numpy()
        poses[n] = Pose(
            expression.clip(0, 1) if model.bounded else expression,
            np.zeros((0, 3, 3)),
            fit.rotation[n].numpy(),
            fit.translation[n].numpy(),
        )
    trust = landmark_trust(model, poses, targets)
    first = min(poses, key=lambda n: float(np.abs(poses[n].rotation[2, :2]).sum()))
    person = add_observation(person, poses[first], views[first])
    for n in sorted(poses, key=lambda n: float(np.linalg.norm(poses[n].rotation - poses[first].rotation))):
        matrix, gradient = landmark_pull(model, poses[n], targets[n])
        pull = (trust * matrix, trust * gradient)
        poses[n], _ = fit_pose(person, [(views[n], FOLLOW_STEPS)], poses[n], poses[n], pull)
        person = add_observation(person, poses[n], views[n])
    found = bundle(head, person, model, poses, views, targets, trust, focal_spread=1e-3)
    identity = fit.identity.clone()
    identity[: len(found.offset)] += torch.from_numpy(found.offset)
    order = sorted(found.poses)
    refined = replace(
        fit,
        identity=identity,
        expression=torch.tensor(np.stack([found.poses[n].expression for n in order])),
        rotation=torch.tensor(np.stack([found.poses[n].rotation for n in order])),
        translation=torch.tensor(np.stack([found.poses[n].translation for n in order])),
    )
    return refined, Gain(*found.costs, float(np.linalg.norm(found.offset)))
