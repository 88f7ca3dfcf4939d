"""Fit the head to photos: landmarks first, then the hair's silhouette."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from uika.fitting.hair import fit_hair
from uika.fitting.landmark_bias import unbiased
from uika.fitting.landmarks import LandmarkFit, fit_landmarks
from uika.fitting.refinement import Gain, follow_known_face, refine_landmark_fit
from uika.fitting.surface_marks import SurfaceMarks
from uika.fitting.teeth import teeth_offset
from uika.head import Camera, HeadModel, HeadParameters


class FittablePhoto(Protocol):
    """What the fit needs of a photo: its landmarks [478,2] and matte [S,S] in crop pixels."""

    @property
    def landmarks(self) -> Tensor:
        """Face mesh points [478,2], pixels."""

    @property
    def matte(self) -> Tensor:
        """Person matte [S,S] in [0,1]."""


@dataclass(frozen=True)
class Fit:
    """N fitted photos.

    parameters: [N] head parameters with one identity; the cameras carry the head's pose.
    cameras: [N] cameras at the crops' size. static_offset [V,3] metres, the hair's displacement of the
    neutral head, which has no bust yet.
    error [N]: mean landmark distance in outer eye-corner distances. gain: of the refinement by colours, if it ran.
    landmarks [N,478,2]: as detected, crop pixels, where they are known.
    head_mattes [N,S,S]: of head and hair, where they were given.
    images: [3,S,S] each, where the colours were to refine the fit.
    """

    parameters: HeadParameters
    cameras: Camera
    static_offset: Tensor
    error: Tensor
    gain: Gain | None = None
    landmarks: Tensor | None = None
    head_mattes: Tensor | None = None
    images: tuple[Tensor, ...] | None = None


def fit_photos(
    photos: Sequence[FittablePhoto],
    head: HeadModel,
    head_mattes: Sequence[Tensor] | None = None,
    *,
    images: Sequence[Tensor] | None = None,
    focals: Sequence[float | None] | None = None,
    correct_detector: bool | None = None,
    known: Fit | None = None,
    marks: SurfaceMarks | None = None,
    bounds: Sequence[tuple[float, float, float, float] | None] | None = None,
) -> Fit:
    """Fit one identity to all photos and expression, camera and hair to each (float32).

    Args:
        photos: prepared photos of one person, all cropped to the same size.
        head: the head model.
        head_mattes: [S,S] per photo, head and hair without shoulders; None fits no hair.
        images: [3,S,S] per photo, sRGB in [0,1]: refine identity and poses with the colours that they share, or share
            with `known`; None does not.
        focals: per photo, the focal length in crop pixels that its camera noted, None where it did not.
        correct_detector: take the face mesh's mean error on turned faces out of the landmarks first. It moves marks off
            the contours that they were found at, but several views then agree on shape and distance. None does so
            where views have to agree: with two or more photos, or a known person.
        known: an earlier fit of the person, whose identity and hair are kept as they are; if it has images, the
            colours of its face refine the new poses.
        marks: where the photos show other points of the surface, see `uika.fitting.SurfaceMarks`.
        bounds: per photo, its left, top, right and lower edge in crop pixels, None where the crop lies inside.

    Raises:
        ValueError: there is no photo, or the photos have different sizes.
    """
    head = head.without_bust
    if not photos:
        raise ValueError("photos: give at least one photo")
    sizes = {tuple(photo.matte.shape) for photo in photos}
    if len(sizes) > 1:
        raise ValueError(f"photos: all crops must have one size, got {sorted(sizes)}")
    height, width = sizes.pop()
    landmarks = torch.stack([photo.landmarks for photo in photos])
    if correct_detector is None:
        correct_detector = len(photos) > 1 or known is not None
    focal = torch.tensor([torch.nan if each is None else each for each in focals]) if focals is not None else None
    if correct_detector:
        landmarks = unbiased(landmarks, fit_landmarks(landmarks, head, width, focal=focal, marks=marks), head)
    identity = None if known is None else known.parameters.identity[0]
    found, gain = fit_landmarks(landmarks, head, width, identity, focal, marks), None
    if images is not None and known is None:
        found, gain = refine_landmark_fit(found, images, landmarks, head)
    elif images is not None and known is not None and known.images is not None and known.landmarks is not None:
        found = follow_known_face(found, images, landmarks, head, _solved(known), known.images, known.landmarks)
    N = len(photos)
    viewmat = torch.eye(4).repeat(N, 1, 1)
    viewmat[:, :3, :3], viewmat[:, :3, 3] = found.rotation.float(), found.translation.float()
    K = torch.eye(3).repeat(N, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = found.focal.float()
    K[:, 0, 2], K[:, 1, 2] = width / 2, height / 2
    cameras = Camera(viewmat, K, width, height)
    parameters = HeadParameters.zeros(head, N).replace(
        identity=found.identity.float().expand(N, -1).contiguous(), expression=found.expression.float()
    )
    offset = teeth_offset(head) if known is None else known.static_offset
    mattes = None if head_mattes is None else torch.stack(list(head_mattes))
    if mattes is not None and known is None:
        whole = (0.0, 0.0, float(width), float(height))
        edges = None if bounds is None else torch.tensor([whole if each is None else each for each in bounds])
        offset = offset + fit_hair(head, parameters, cameras, mattes, edges)
    detected = torch.stack([photo.landmarks for photo in photos])
    pictures = None if images is None else tuple(images)
    return Fit(parameters, cameras, offset, found.error.float(), gain, detected, mattes, pictures)


def _solved(fit: Fit) -> LandmarkFit:
    viewmat, parameters = fit.cameras.viewmat.double(), fit.parameters
    return LandmarkFit(
        parameters.identity[0].double(),
        parameters.expression.double(),
        viewmat[:, :3, :3],
        viewmat[:, :3, 3],
        fit.cameras.K[:, 0, 0].double(),
        fit.error.double(),
    )
