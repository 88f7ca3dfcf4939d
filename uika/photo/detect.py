"""Find the largest face of a photo and place its 478 landmarks precisely, also in large photos with small faces."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uika.photo.crop import Square, resample, to_photo
from uika.photo.networks import face_boxes, face_meshes

SCAN_SIDE = 640  # the detectors shrink their input to 192 or 128 px, so more would be lost
LARGE_SIDE = 4 * SCAN_SIDE  # the smallest tiles need no more than this of the photo
WIDE = 3.0  # long side over short side of a panorama, whose faces are small against its length
MESH_SIDE = 512
FACE_MARGIN = 2.0  # side of the crop given to the face mesh, in face sizes
# Crops of the second pass: (scale, shift x, shift y) relative to the margin above. Their mean is steadier than any one.
PASSES = ((1.0, 0.0, 0.0), (0.85, 0.03, 0.0), (1.2, -0.03, 0.03))
# Mean distance of any pass from their mean, in face sizes, above which it is no face: real faces stay below 0.02,
# the wheels and lamps that the detector takes for faces lie above 0.05.
MAX_SPREAD = 0.035
MIN_FACE = 24  # pixels


def find_face(photo: NDArray[np.uint8]) -> NDArray[np.float64] | None:
    """Landmarks [478,2] (mediapipe face mesh order, photo pixels, centres at +0.5) of the largest face, or None.

    Looks at the whole photo first, then, when nothing is found, at the photo with a border (close-ups), then at
    overlapping tiles of a half and a quarter of the photo (small faces), then along a panorama. A detection counts when
    several crops of it agree.
    """
    shrink = max(1.0, max(photo.shape[:2]) / LARGE_SIDE)
    overview = _shrunk(photo, shrink)
    rounds = [(overview, squares, shrink) for squares in _searches(*overview.shape[:2])]
    low, high = sorted(photo.shape[:2])
    if high > WIDE * low:
        shrink = max(1.0, low / LARGE_SIDE)
        strip = _shrunk(photo, shrink)
        rounds.append((strip, _along(*strip.shape[:2]), shrink))
    for picture, squares, scale in rounds:
        for face in _faces(picture, squares, scale):
            landmarks = _refine(photo, face)
            if landmarks is not None:
                return landmarks
    return None


def _along(height: int, width: int) -> list[Square]:
    """Overlapping squares as wide as a panorama's short side."""
    low, high = sorted((height, width))
    places = np.linspace(0, high - low, 2 * math.ceil(high / low))
    return [(float(at), 0.0, float(low)) if width > height else (0.0, float(at), float(low)) for at in places]


def _searches(height: int, width: int) -> list[list[Square]]:
    """Squares to scan, in rounds: a later round is only needed when the earlier ones found no face."""
    centre = np.array([width, height]) / 2
    rounds = [[_square(centre, max(height, width))], [_square(centre, 1.7 * max(height, width))]]
    for share in (2, 4):
        side = max(height, width) / share
        if side < MESH_SIDE / 4:
            break
        columns = np.linspace(0, max(width - side, 0), max(1, round(2 * width / side) - 1))
        rows = np.linspace(0, max(height - side, 0), max(1, round(2 * height / side) - 1))
        rounds.append([(float(x), float(y), side) for y in rows for x in columns])
    return rounds


def _shrunk(photo: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    from PIL import Image

    if factor == 1.0:
        return photo
    height, width = photo.shape[:2]
    size = (max(1, round(width / factor)), max(1, round(height / factor)))
    return np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.BOX))


def _faces(overview: NDArray[np.uint8], squares: list[Square], shrink: float) -> list[Square]:
    """Squares in the photo around the faces detected in its `shrink` times smaller overview, largest first."""
    scans = [resample(overview, square, SCAN_SIDE) for square in squares]
    faces = []
    for square, boxes in zip(squares, face_boxes(scans), strict=True):
        for x, y, width, height in boxes:
            centre = to_photo(np.array([x + width / 2, y + height / 2]), square, SCAN_SIDE)
            faces.append(_square(centre * shrink, max(width, height) * square[2] / SCAN_SIDE * shrink))
    return sorted(faces, key=lambda face: -face[2])


def _refine(photo: NDArray[np.uint8], face: Square) -> NDArray[np.float64] | None:
    """Landmarks from a first crop around the detection, then the mean over crops centred on those landmarks."""
    centre, side = np.array(face[:2]) + face[2] / 2, face[2] * FACE_MARGIN
    first = meshes_in(photo, [_square(centre, side)])[0]
    if first is None:
        return None
    low, high = first.min(axis=0), first.max(axis=0)
    side = FACE_MARGIN * float((high - low).max())
    squares = [_square((low + high) / 2 + side * np.array([dx, dy]), side * scale) for scale, dx, dy in PASSES]
    found = np.array([mesh for mesh in meshes_in(photo, squares) if mesh is not None])
    if len(found) < 2:
        return None
    mean = found.mean(axis=0)
    size = np.ptp(mean, axis=0).max()
    spread = np.linalg.norm(np.stack([first, *found]) - mean, axis=-1).mean(axis=-1).max()
    return mean if size > MIN_FACE and spread < MAX_SPREAD * size else None


def meshes_in(photo: NDArray[np.uint8], squares: list[Square]) -> list[NDArray[np.float64] | None]:
    """Landmarks [478,2] in photo pixels of the largest face in each square of it, or None."""
    meshes = face_meshes([resample(photo, square, MESH_SIDE) for square in squares])
    return [
        None if mesh is None else to_photo(mesh, square, MESH_SIDE)
        for mesh, square in zip(meshes, squares, strict=True)
    ]


def _square(centre: NDArray[np.float64], side: float) -> Square:
    x, y = centre - side / 2
    return float(x), float(y), float(side)
