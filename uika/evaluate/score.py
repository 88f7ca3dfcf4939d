"""Numbers for the pictures of one sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from uika.evaluate.protocol import Protocol
from uika.head import HeadModel
from uika.metrics import expression_distance, fit_faces, flip_map, keypoint_distance, pose_distance, psnr
from uika.metrics.arcface import ArcFace, identity_similarity
from uika.metrics.face_descriptor import face_distance
from uika.metrics.faces import find_landmarks
from uika.metrics.image import ssim_pixels
from uika.metrics.lpips import Lpips
from uika.metrics.structural_similarity import SSIM_REACH

Scores = dict[str, list[float | None]]  # metric -> its value for each frame, None where it has none


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures [S,S,3] in [0,1] with the landmarks [478,2] of their faces, None where none was found."""

    images: list[Tensor]
    landmarks: list[Tensor | None]

    @staticmethod
    def of(images: Sequence[Tensor], like: Pictures | None = None) -> Pictures:
        """Look for the faces; given the pictures `like` which they should be, only where those have one."""
        wanted = [True] * len(images) if like is None else [marks is not None for marks in like.landmarks]
        marks = [find_landmarks(image) if look else None for image, look in zip(images, wanted, strict=True)]
        return Pictures(list(images), marks)


@dataclass(frozen=True, eq=False)
class Judges:
    """What scores need besides the pictures; None for networks whose files were not given."""

    head: HeadModel
    lpips: Lpips | None = None
    arcface: ArcFace | None = None


def score(
    results: Pictures,
    truths: Pictures,
    masks: Sequence[Tensor],
    person: Pictures,
    protocol: Protocol,
    judges: Judges,
) -> Scores:
    """Every metric of the protocol for every frame.

    Args:
        results: T pictures to judge.
        truths: T pictures that they should look like, or whose expression and pose they should have.
        masks: T masks [S,S] bool of the person in the truths.
        person: one picture of the person whom the results should show, where it is not in the truths.
        protocol: says which metrics.
        judges: head and networks.
    """
    found: Scores = {metric.name: [None] * len(truths.images) for metric in protocol.metrics}
    if protocol.task == "self":
        for index, (image, truth, mask) in enumerate(zip(results.images, truths.images, masks, strict=True)):
            for name, value in _picture_scores(image, truth, mask, judges).items():
                found[name][index] = value
    for index, values in _face_scores(results, truths, protocol, judges.head).items():
        for name, value in values.items():
            found[name][index] = value
    for index, (image, marks) in enumerate(zip(results.images, results.landmarks, strict=True)):
        model, place = (truths, index) if protocol.task == "self" else (person, 0)
        other = model.landmarks[place]
        if marks is not None and other is not None:
            pair = (image, marks), (model.images[place], other)
            found["face distance"][index] = face_distance(*pair)
            if judges.arcface is not None:
                found["CSIM"][index] = identity_similarity(judges.arcface, *pair)
    return found


def faces_found(results: Pictures, truths: Pictures) -> list[int]:
    """Frames in which both have a face."""
    pairs = zip(results.landmarks, truths.landmarks, strict=True)
    return [index for index, pair in enumerate(pairs) if pair[0] is not None and pair[1] is not None]


def mean(values: Sequence[float | None]) -> float | None:
    """The mean of those values that are there; None when none is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _picture_scores(image: Tensor, truth: Tensor, mask: Tensor, judges: Judges) -> dict[str, float]:
    error, likeness = flip_map(image, truth), ssim_pixels(image, truth)
    scores = {"PSNR": psnr(image, truth), "SSIM": float(likeness.mean()), "FLIP": float(error.mean())}
    inner = mask[SSIM_REACH:-SSIM_REACH, SSIM_REACH:-SSIM_REACH]
    if bool(inner.any()):
        scores["PSNR masked"] = psnr(image, truth, mask)
        scores["SSIM masked"] = float(likeness[inner].mean())
        scores["FLIP masked"] = float(error[mask].mean())
    if judges.lpips is not None:
        with torch.no_grad():
            scores["LPIPS"] = float(judges.lpips(*(each.permute(2, 0, 1)[None] for each in (image, truth))))
    return scores


def _face_scores(
    results: Pictures, truths: Pictures, protocol: Protocol, head: HeadModel
) -> dict[int, dict[str, float]]:
    both = faces_found(results, truths)
    if not both:
        return {}
    first, second = (
        torch.stack([marks for index in both if (marks := pictures.landmarks[index]) is not None])
        for pictures in (results, truths)
    )
    fits = fit_faces(first, head, protocol.size), fit_faces(second, head, protocol.size)
    expression, pose = expression_distance(*fits), pose_distance(*fits)
    points = keypoint_distance(first, second, protocol.size)
    return {
        index: {"AED": float(expression[k]), "APD": float(pose[k]), "AKD": float(points[k])}
        for k, index in enumerate(both)
    }
