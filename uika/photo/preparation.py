"""From a photo file to the square, matted, landmarked crop that the rest of the program works on."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.errors import UikaWarning
from uika.photo import matte
from uika.photo.color_evidence import decided
from uika.photo.crop import Square, coverage, pixel_centres, resample, to_crop, to_photo
from uika.photo.detect import find_face
from uika.photo.error import PhotoError
from uika.photo.foreground import estimate_foreground
from uika.photo.networks import person_mask
from uika.photo.outline import CHIN, FOREHEAD, MOUTH_CORNERS, OVAL, face_frame, polygon
from uika.photo.read import Picture, read
from uika.photo.trust import judge

HEAD_TO_FACE = 1.35  # height of a head over the height of its face, forehead line to chin
CROP_TO_HEAD = 1.5  # side of the crop over the larger side of the head box (released inference settings)
HAIR_LIMIT = 1.0  # hair is looked for up to this many face heights beyond the face
EDGE_STEP = 0.02  # of the crop: the segmentation is unreliable this close to the photo's edge
SCAN_SIDE = 256  # pixels, the resolution of the segmentation model
MIN_SIZE, MAX_SIZE = 64, 2048
BUST_TO_CROP = 1.75  # side of the crop that shows the shoulders too, over the head's; both have one top


@dataclass(frozen=True)
class BustCrop:
    """A wider crop of a photo, of B x B pixels, for the shoulders.

    image [3,B,B] and matte [B,B] as those of `Photo`; inside [B,B] is the share of each pixel that lies in the photo;
    crop (x0, y0, side) in pixels of the upright photo.
    """

    image: Tensor
    matte: Tensor
    inside: Tensor
    crop: Square


@dataclass(frozen=True)
class Photo:
    """A photo ready for fitting and reconstruction; S is the crop's size in pixels.

    path as given; sha256 of the file. image [3,S,S] float32 sRGB in [0,1], the person on a plain background;
    matte [S,S] float32 in [0,1], 1 = person (hair, face, neck, shoulders), 0 outside the photo;
    landmarks [478,2] float32 in crop pixels (pixel centres at +0.5, may lie outside), mediapipe face mesh order;
    crop (x0, y0, side) of the square in the upright photo, in its pixels;
    original [3,S,S] float32, the crop with its own background;
    focal length in crop pixels if the file tells it;
    bust, a wider crop if it was asked for.
    person: whether the face looks like a person's rather than, say, an animal's.
    bounds: left, top, right and lower edge of the photo in crop pixels; the crop may reach beyond.
    """

    path: str
    sha256: str
    image: Tensor
    matte: Tensor
    landmarks: Tensor
    crop: Square
    original: Tensor
    focal: float | None = None
    bust: BustCrop | None = None
    person: bool = True
    bounds: tuple[float, float, float, float] | None = None


def prepare(
    path: str | Path,
    size: int = 512,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    bust: bool = False,
) -> Photo:
    """Read a photo, find its largest face, crop the head, matte it and put it on `background` (sRGB in [0,1]).

    The crop is a square of 1.5 times the head's box, the head being the face extended over the hair; it may reach
    outside the photo, where the matte is 0. A file with transparency around the person brings its own matte.
    With `bust`, a wider crop is cut out too. The same file gives the same result.
    Raises `PhotoError` when the file cannot be read, shows no face, or one on its head.
    """
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise ValueError(f"size: must lie between {MIN_SIZE} and {MAX_SIZE} pixels, got {size}")
    if len(background) != 3 or not all(0.0 <= level <= 1.0 for level in background):
        raise ValueError(f"background: give three sRGB levels between 0 and 1, got {background}")
    picture = read(path)
    rgb = _opaque(picture, background)
    face = find_face(rgb)
    if face is None:
        raise PhotoError(
            path,
            "shows no face that is found; use an upright, sharp photo with the whole face, 50 px high or more",
        )
    trust = judge(rgb, face)
    if trust.problem:
        raise PhotoError(path, trust.problem)
    if not trust.person:
        warnings.warn(
            f"{path}: its face hardly looks like a person's (an animal, or hidden?)", UikaWarning, stacklevel=2
        )
    square = _head_square(rgb, face)
    landmarks = to_crop(face, square, size)
    crop, alpha, colours, inside = _cut_out(picture, rgb, square, landmarks, size)
    plain = np.array(background, dtype=np.float32)
    return Photo(
        path=picture.path,
        sha256=picture.sha256,
        image=_chw(plain + alpha[..., None] * (colours - plain)),
        matte=torch.from_numpy(alpha),
        landmarks=torch.from_numpy(landmarks.astype(np.float32)),
        crop=square,
        original=_chw(plain + inside[..., None] * (crop.astype(np.float32) / 255 - plain)),
        focal=None if picture.focal is None else picture.focal * size / square[2],
        bust=_bust_crop(picture, rgb, square, face, size, plain) if bust else None,
        person=trust.person,
        bounds=_bounds(rgb, square, size),
    )


def _bounds(rgb: NDArray[np.uint8], square: Square, size: int) -> tuple[float, float, float, float]:
    height, width = rgb.shape[:2]
    (left, top), (right, low) = to_crop(np.array([[0.0, 0.0], [width, height]]), square, size).tolist()
    return left, top, right, low


def _bust_crop(
    picture: Picture,
    rgb: NDArray[np.uint8],
    head: Square,
    face: NDArray[np.float64],
    size: int,
    plain: NDArray[np.float32],
) -> BustCrop:
    x0, y0, side = head
    square = (x0 - (BUST_TO_CROP - 1) / 2 * side, y0, BUST_TO_CROP * side)
    _, alpha, colours, inside = _cut_out(picture, rgb, square, to_crop(face, square, size), size)
    image = _chw(plain + alpha[..., None] * (colours - plain))
    return BustCrop(image, torch.from_numpy(alpha), torch.from_numpy(inside), square)


def _cut_out(
    picture: Picture, rgb: NDArray[np.uint8], square: Square, landmarks: NDArray[np.float64], size: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """A crop [S,S,3], its matte [S,S], the person's colours [S,S,3], and how far each pixel lies in the photo [S,S]."""
    crop = resample(rgb, square, size)
    inside = coverage(rgb.shape[:2], square, size)
    alpha = _matte(crop, landmarks, inside)
    colours = estimate_foreground((crop / 255).astype(np.float32), alpha)
    if picture.alpha is not None:
        given = (resample(picture.alpha, square, size) / 255).astype(np.float32)
        alpha, colours = _merge(alpha, given, colours, resample(picture.rgb, square, size))
    return crop, alpha * inside, colours, inside


def _opaque(picture: Picture, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """The picture [H,W,3] composited on the background where it is transparent."""
    if picture.alpha is None:
        return picture.rgb
    share = picture.alpha[..., None] / np.float32(255)
    plain = np.array(background, dtype=np.float32) * 255
    return np.round(plain + share * (picture.rgb - plain)).astype(np.uint8)


def _head_square(rgb: NDArray[np.uint8], face: NDArray[np.float64]) -> Square:
    """Crop around the head: the face's box extended over the skull, then over the hair that the segmentation shows."""
    up = face[FOREHEAD] - face[CHIN]
    height = float(np.linalg.norm(up))
    head = np.concatenate([face, face + (HEAD_TO_FACE - 1) * up])
    low, high = head.min(axis=0), head.max(axis=0)
    side = float((high - low).max()) + 2 * HAIR_LIMIT * height
    x0, y0 = (low + high - side) / 2
    scan = (float(x0), float(y0), side)
    person = person_mask(resample(rgb, scan, SCAN_SIDE)) * coverage(rgb.shape[:2], scan, SCAN_SIDE) > 0.5
    across, above = face_frame(face, to_photo(pixel_centres(SCAN_SIDE), scan, SCAN_SIDE))
    sideways = face_frame(face, face)[0]
    person &= (across > sideways.min() - HAIR_LIMIT) & (across < sideways.max() + HAIR_LIMIT)
    person &= above > face_frame(face, face[list(MOUTH_CORNERS)])[1].mean()  # shoulders show below
    hair = to_photo(pixel_centres(SCAN_SIDE)[person], scan, SCAN_SIDE)
    head = np.concatenate([head, hair])
    low, high = head.min(axis=0), head.max(axis=0)
    side = CROP_TO_HEAD * float((high - low).max())
    x0, y0 = (low + high - side) / 2
    return float(x0), float(y0), side


def _matte(crop: NDArray[np.uint8], landmarks: NDArray[np.float64], inside: NDArray[np.float32]) -> NDArray[np.float32]:
    """Matte [S,S] of a crop [S,S,3]; where `inside` [S,S] is 0, crop and mask repeat the photo's edge."""
    size = crop.shape[0]
    oval = landmarks[list(OVAL)]
    sure = polygon(oval.mean(axis=0) + 0.85 * (oval - oval.mean(axis=0)), size)
    rough = person_mask(crop)
    beyond = inside < 0.5
    if beyond.any() and not beyond.all():
        # Repeated edges make stripes that may look like people: beside the head, a plain surrounding has a say too.
        plain = np.where(beyond[..., None], crop[~beyond].mean(axis=0).astype(np.uint8), crop)
        beside = face_frame(landmarks, pixel_centres(size))[1] > 0
        rough = np.where(beside, np.minimum(rough, person_mask(plain)), rough)
    step = round(EDGE_STEP * size)
    for axis in (0, 1):
        seen = np.flatnonzero(inside.max(axis=1 - axis) > 0)
        first = seen[0] + (step if seen[0] > 0 else 0)
        last = seen[-1] - (step if seen[-1] < size - 1 else 0)
        rough = rough.take(np.arange(size).clip(first, last), axis=axis)
    return matte.solve(crop, decided(matte.trimap(rough, sure), crop, rough, sure, inside))


def _merge(
    alpha: NDArray[np.float32], given: NDArray[np.float32], colours: NDArray[np.float32], own: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Matte and colours when the file has an alpha channel: it is the matte if it cuts the background away.

    An alpha channel that keeps the background (rounded corners, say) only takes away from the estimated matte.
    """
    behind = alpha < 0.5
    if behind.any() and float(given[behind].mean()) < 0.5:
        return given, (own / 255).astype(np.float32)
    return alpha * given, colours


def _chw(image: NDArray) -> Tensor:
    return torch.from_numpy(image.astype(np.float32).clip(0, 1).transpose(2, 0, 1).copy())
