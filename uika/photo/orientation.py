"""Whether a face stands upright enough for its landmarks to be right."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uika.photo.crop import Square, resample, to_photo
from uika.photo.networks import face_meshes, face_scores

SIZE = 512  # pixels of the crop that is turned
MARGIN = 2.0  # its side in face sizes
# Summed score of the two detectors (0 to 2) by which a turned crop must be the better face. The portrait's own turns by
# up to 100 degrees lie within 0.4, with right landmarks; faces on their head 0.8 and more behind.
DOUBT = 0.2
AGREEMENT = 0.08  # mean landmark distance in face sizes; right ones agree to 0.03, upside-down ones differ by 0.5


def turned_by(photo: NDArray[np.uint8], landmarks: NDArray[np.float64]) -> int:
    """Degrees, a multiple of 90, by which the photo must be turned counterclockwise; 0 if its landmarks can be trusted.

    The face mesh is trained on upright faces: on one that stands on its head it finds eyes where the mouth is, and its
    crops agree with each other about it. The face detectors, however, see a better face once the photo is turned.

    Args:
        photo: [H,W,3] sRGB.
        landmarks: [478,2] found in it, in pixels.
    """
    low, high = landmarks.min(axis=0), landmarks.max(axis=0)
    extent = float((high - low).max())
    x, y = (low + high) / 2 - MARGIN * extent / 2
    square: Square = (float(x), float(y), MARGIN * extent)
    crop = resample(photo, square, SIZE)
    turned = [np.ascontiguousarray(np.rot90(crop, k)) for k in range(4)]
    scores = face_scores(turned)
    best = int(np.argmax(scores))
    if scores[best] < scores[0] + DOUBT:
        return 0
    mesh = face_meshes([turned[best]])[0]
    if mesh is None:
        return 0
    other = to_photo(_turned_back(mesh, best), square, SIZE)
    return 0 if np.linalg.norm(other - landmarks, axis=1).mean() < AGREEMENT * extent else 90 * best


def _turned_back(points: NDArray[np.float64], turns: int) -> NDArray[np.float64]:
    """Points [...,2] of a square crop turned `turns` times by 90 degrees counterclockwise, in the unturned crop."""
    for _ in range(turns):
        points = np.stack((SIZE - points[..., 1], points[..., 0]), axis=-1)
    return points
