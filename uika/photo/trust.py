"""Whether landmarks that were found can be trusted: faces on their head, and faces that the detectors doubt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uika.photo.crop import Square, resample, to_photo
from uika.photo.detect import FACE_MARGIN, MESH_SIDE, PASSES, meshes_in
from uika.photo.networks import face_meshes, face_scores

# Summed score of the two detectors (0 to 2) by which a turned crop must be the better face. The portrait's own turns by
# up to 100 degrees lie within 0.4, with right landmarks; faces on their head 0.8 and more behind.
BETTER = 0.2
AGREEMENT = 0.08  # mean landmark distance in face sizes; right ones agree to 0.03, upside-down ones differ by 0.5
# Photos of whole faces score 1.53 and more. Below, faces are blurred, noisy, covered, cut off or lie on their side,
# and the landmarks of several crops must agree closely: of 200 spoiled portraits this refuses all whose landmarks are
# off by more than 3 % of the face's height, and 5 of those that are not. Mean distances in face sizes.
SURE = 1.5
MAX_SPREAD = 0.0125  # of shifted crops from their mean
MAX_LEANING = 0.02  # of crops turned to both sides from the upright one
LENIENCE = 1.6  # times both for what hardly looks like a person's face and is warned of: drawings and animals
LEANING = 15.0  # degrees
# Dogs whose landmarks agree score 0.8; people, their paintings, statues and cartoons 1.46 and more.
PERSON = 1.2


@dataclass(frozen=True)
class Trust:
    """What is thought of a found face: why it cannot be used, or empty; and whether it looks like a person's."""

    problem: str
    person: bool


def judge(photo: NDArray[np.uint8], landmarks: NDArray[np.float64]) -> Trust:
    """Whether the landmarks [478,2] found in a photo [H,W,3] can be trusted."""
    square, crop = _crop(photo, landmarks)
    scores = _scores(crop)
    if degrees := _turned_by(landmarks, square, crop, scores):
        return Trust(f"the face in it is not upright; turn the photo by {degrees} degrees counterclockwise", True)
    lenience = 1.0 if scores[0] >= PERSON else LENIENCE
    if scores[0] < SURE and not _agree(photo, square, crop, lenience):
        animal = "" if scores[0] >= PERSON else " or hardly a person's"
        return Trust(
            f"the face in it is too blurred, noisy, covered or cut off{animal} for its landmarks to be found; use a "
            "clear photo of the whole face",
            True,
        )
    return Trust("", scores[0] >= PERSON)


def turned_by(photo: NDArray[np.uint8], landmarks: NDArray[np.float64]) -> int:
    """Degrees, a multiple of 90, by which the photo must be turned counterclockwise; 0 if its landmarks can be trusted.

    The face mesh is trained on upright faces: on one that stands on its head it finds eyes where the mouth is, and its
    crops agree with each other about it. The face detectors, however, see a better face once the photo is turned.

    Args:
        photo: [H,W,3] sRGB.
        landmarks: [478,2] found in it, in pixels.
    """
    square, crop = _crop(photo, landmarks)
    return _turned_by(landmarks, square, crop, _scores(crop))


def _crop(photo: NDArray[np.uint8], landmarks: NDArray[np.float64]) -> tuple[Square, NDArray[np.uint8]]:
    low, high = landmarks.min(axis=0), landmarks.max(axis=0)
    side = FACE_MARGIN * float((high - low).max())
    x, y = (low + high) / 2 - side / 2
    square = (float(x), float(y), side)
    return square, resample(photo, square, MESH_SIDE)


def _scores(crop: NDArray[np.uint8]) -> list[float]:
    return face_scores([np.ascontiguousarray(np.rot90(crop, k)) for k in range(4)])


def _turned_by(landmarks: NDArray[np.float64], square: Square, crop: NDArray[np.uint8], scores: list[float]) -> int:
    best = int(np.argmax(scores))
    if scores[best] < scores[0] + BETTER:
        return 0
    mesh = face_meshes([np.ascontiguousarray(np.rot90(crop, best))])[0]
    if mesh is None:
        return 0
    other = to_photo(_turned_back(mesh, 90.0 * best), square, MESH_SIDE)
    apart = np.linalg.norm(other - landmarks, axis=1).mean() * FACE_MARGIN / square[2]
    return 0 if apart < AGREEMENT else 90 * best


def _agree(photo: NDArray[np.uint8], square: Square, crop: NDArray[np.uint8], lenience: float) -> bool:
    """Whether shifted, scaled and leaning crops show the same landmarks."""
    x, y, side = square
    shifted = [
        (x + side * (dx + (1 - scale) / 2), y + side * (dy + (1 - scale) / 2), side * scale) for scale, dx, dy in PASSES
    ]
    found = meshes_in(photo, shifted)
    upright, *leaning = face_meshes([crop, *(_leaning(crop, degrees) for degrees in (-LEANING, LEANING))])
    if upright is None or any(mesh is None for mesh in (*found, *leaning)):
        return False
    size = side / FACE_MARGIN
    meshes = np.array(found)
    spread = np.linalg.norm(meshes - meshes.mean(axis=0), axis=-1).mean(axis=-1).max() / size
    back = [
        _turned_back(mesh, degrees)
        for mesh, degrees in zip(leaning, (-LEANING, LEANING), strict=True)
        if mesh is not None
    ]
    apart = max(float(np.linalg.norm(mesh - upright, axis=1).mean()) for mesh in back) * FACE_MARGIN / MESH_SIDE
    return bool(spread < lenience * MAX_SPREAD and apart < lenience * MAX_LEANING)


def _leaning(crop: NDArray[np.uint8], degrees: float) -> NDArray[np.uint8]:
    from PIL import Image

    fill = tuple(int(value) for value in crop.reshape(-1, 3).mean(axis=0))
    return np.asarray(Image.fromarray(crop).rotate(degrees, Image.Resampling.BILINEAR, fillcolor=fill))


def _turned_back(points: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Points [...,2] of a square crop turned counterclockwise, in the unturned crop."""
    angle = np.deg2rad(degrees)
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return (points - MESH_SIDE / 2) @ matrix.T + MESH_SIDE / 2
