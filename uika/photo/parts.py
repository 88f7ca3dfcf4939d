"""The head's share of a matte: face, ears and hair without neck, shoulders and clothes."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.photo import matte
from uika.photo.color_evidence import SURE, bins, likeness
from uika.photo.crop import pixel_centres
from uika.photo.outline import JAW, OVAL, face_frame, polygon
from uika.photo.preparation import Photo

EAR_LOBES = (132, 361)
JAW_CORNERS = (172, 397)
# In face heights (forehead line to chin).
HAIR_DROP = 0.3  # hair beside the neck is kept down to this far below the chin
CUT = 0.04  # width of the soft cut under the jaw
HAIR_FROM, HAIR_TO = 0.2, 0.5  # the solution fades along hanging hair: what keeps half of it is all hair
HAIR_ABOVE = 0.9  # height from which what is not the face is hair
WIDER, SKIN_SHARE = 1.12, 0.85  # outlines around the face's that leave its edge alone, and inside it that show skin
FINGERS = 0.016  # of the crop's side, between fingers
APART = 0.7  # share of the hair that must look unlike skin for hands to be told from it
FAINT = 0.05  # matte below which a pixel beside the neck counts as background


def head_matte(photo: Photo) -> Tensor:
    """Matte [S,S] float32 in [0,1] of the head alone: `photo.matte` cut below the jaw.

    Under the jaw the cut follows the jaw's outline. Beside it, from the ear lobes down, hair and clothes are told apart
    by closed-form matting, with everything higher known as head and the neck and everything well below the chin known
    as rest. Hair that hangs lower than that is lost.
    """
    from scipy import ndimage

    size = photo.matte.shape[-1]
    points = photo.landmarks.double().numpy()
    across, above = face_frame(points, pixel_centres(size))
    jaw_across, jaw_above = face_frame(points, points[list(JAW)])
    order = np.argsort(jaw_across)
    below_jaw = np.interp(across, jaw_across[order], jaw_above[order]) - above
    corners = face_frame(points, points[list(JAW_CORNERS)])[0]
    neck = (across > corners.min()) & (across < corners.max()) & (below_jaw > CUT)
    lobes = face_frame(points, points[list(EAR_LOBES)])[1].max()

    known = np.where(photo.matte.numpy() < FAINT, 0.0, 0.5)
    known[neck | (above < -HAIR_DROP)] = 0.0
    face = polygon(points[list(OVAL)], size)
    known[(above > lobes) | face] = 1.0
    image = (photo.original.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    known[_hands(image, photo.matte.numpy(), points[list(OVAL)], above, lobes)] = 0.0
    share = ((matte.solve(image, known) - HAIR_FROM) / (HAIR_TO - HAIR_FROM)).clip(0, 1)
    parts, _ = ndimage.label((share > FAINT) & (photo.matte.numpy() > FAINT))
    own = np.isin(parts, np.unique(parts[face & (parts > 0)]))
    return torch.minimum(photo.matte, torch.from_numpy(np.where(own, share, np.float32(0.0))))


def _hands(
    image: NDArray[np.uint8], opaque: NDArray[np.float32], oval: NDArray[np.float64], above: NDArray, lobes: float
) -> NDArray[np.bool_]:
    """Pixels [S,S] below the ear lobes beside the face that have the colour of skin and not of hair."""
    from scipy import ndimage

    size = len(image)
    face = polygon(oval, size)
    beyond = ~polygon(oval.mean(axis=0) + WIDER * (oval - oval.mean(axis=0)), size)
    solid = opaque > 0.95
    hair, skin = (
        solid & ~face & (above > HAIR_ABOVE),
        solid & polygon(oval.mean(axis=0) + SKIN_SHARE * (oval - oval.mean(axis=0)), size),
    )
    if not hair.any() or not skin.any():
        return np.zeros_like(face)
    place = bins(image)
    share, seen = likeness(place, hair, skin)
    if (share[hair] > 0.5).mean() < APART:
        return np.zeros_like(face)
    reach = round(FINGERS * size)
    shown = ndimage.binary_opening(seen & (share < 1 - SURE), iterations=2)
    shown = ndimage.binary_dilation(ndimage.binary_closing(shown, iterations=reach), iterations=reach // 2)
    return beyond & (above < lobes) & shown & ~(seen & (share > SURE))
