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
from uika.fitting.photometric import Appearance, FaceCrop, add_observation, crop_face, fit_pose, make_appearance
from uika.head import HeadModel
from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose, frame_model

BLUR = 0.8  # pixels of the face crop
FOLLOW_STEPS = 6
FAR, FAR_STEPS = 2.5, 4  # a blur at which a pose finds its way from afar
KNOWN_PULL = 0.03  # of landmarks that colours of a known face correct: an error that all share moves the pose unseen
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
    photos = dict(enumerate(_photos(fit, images, landmarks, nominal, model)))
    views = {n: photo.views[-1][0] for n, photo in photos.items()}
    poses, targets = {n: photo.pose for n, photo in photos.items()}, {n: photo.target for n, photo in photos.items()}
    trust = landmark_trust(model, poses, targets)
    first = min(poses, key=lambda n: float(np.abs(poses[n].rotation[2, :2]).sum()))
    person = make_appearance(head, fit.identity, nominal, unit)
    person = add_observation(person, poses[first], views[first])
    for n in sorted(poses, key=lambda n: float(np.linalg.norm(poses[n].rotation - poses[first].rotation))):
        poses[n] = _followed(person, photos[n], model, trust)
        person = add_observation(person, poses[n], views[n])
    found = bundle(head, person, model, poses, views, targets, trust, focal_spread=1e-3)
    identity = fit.identity.clone()
    identity[: len(found.offset)] += torch.from_numpy(found.offset)
    refined = _with_poses(replace(fit, identity=identity), [found.poses[n] for n in sorted(found.poses)])
    return refined, Gain(*found.costs, float(np.linalg.norm(found.offset)))


def follow_known_face(
    fit: LandmarkFit,
    images: Sequence[Tensor],
    landmarks: Tensor,
    head: HeadModel,
    known: LandmarkFit,
    known_images: Sequence[Tensor],
    known_landmarks: Tensor,
) -> LandmarkFit:
    """Refine expressions and poses of new photos with the colours that earlier photos of the person show.

    Landmarks alone would put the same face a little elsewhere than a fit by colours did.

    Args:
        fit: the landmark fit of N new photos, of the known identity.
        images: [3,S,S] each, sRGB in [0,1].
        landmarks: [N,478,2] pixels, for the pull that keeps the face in place.
        head: the head model.
        known: the fit of the M earlier photos.
        known_images: as `images`, of those.
        known_landmarks: [M,478,2] pixels.

    Returns:
        The refined fit; the same one for heads whose jaw and eyes are joints, which a landmark fit leaves at rest.
    """
    nominal, unit = float(known.focal.median()), eye_distance(head)
    model = frame_model(head, known.identity, nominal, unit)
    if model.joints:
        return fit
    person = make_appearance(head, known.identity, nominal, unit)
    for photo in _photos(known, known_images, known_landmarks, nominal, model):
        person = add_observation(person, photo.pose, photo.views[-1][0])
    photos = _photos(fit, images, landmarks, nominal, model)
    return _with_poses(fit, [_followed(person, photo, model, KNOWN_PULL) for photo in photos])


@dataclass(frozen=True)
class _Photo:
    """A photo as one camera of the nominal focal length would take it."""

    pose: Pose
    target: Array  # [478,2] landmarks in pixels relative to the principal point
    views: list[tuple[FaceCrop, int]]  # from blurred to sharp, each with its number of steps


def _photos(
    fit: LandmarkFit, images: Sequence[Tensor], landmarks: Tensor, nominal: float, model: FrameModel
) -> list[_Photo]:
    result = []
    for n, (image, mark, focal) in enumerate(zip(images, landmarks, fit.focal.tolist(), strict=True)):
        grey = (torch.einsum("chw,c->hw", image, image.new_tensor(_LUMA)) * 255).round().byte().numpy()
        marks, centre = mark.double().numpy(), np.array([image.shape[2], image.shape[1]]) / 2
        scale = nominal / focal
        views = []
        for blur, steps in ((FAR, FAR_STEPS), (BLUR, FOLLOW_STEPS)):
            view = crop_face(grey, marks, centre, blur)
            views.append((replace(view, corner=view.corner * scale, scale=view.scale / scale), steps))
        expression = fit.expression[n].numpy()
        pose = Pose(
            expression.clip(0, 1) if model.bounded else expression,
            np.zeros((0, 3, 3)),
            fit.rotation[n].numpy(),
            fit.translation[n].numpy(),
        )
        result.append(_Photo(pose, (marks - centre) * scale, views))
    return result


def _followed(person: Appearance, photo: _Photo, model: FrameModel, trust: float) -> Pose:
    """The pose that shows the person's colours where the photo does."""
    matrix, gradient = landmark_pull(model, photo.pose, photo.target)
    return fit_pose(person, photo.views, photo.pose, photo.pose, (trust * matrix, trust * gradient))[0]


def _with_poses(fit: LandmarkFit, poses: Sequence[Pose]) -> LandmarkFit:
    expression, rotation, translation = (
        torch.tensor(np.stack([getattr(pose, name) for pose in poses]))
        for name in ("expression", "rotation", "translation")
    )
    return replace(fit, expression=expression, rotation=rotation, translation=translation)
