"""What colours say about a rough segmentation: background seen through hair, and hair that was not found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bins = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]

BINS = 24  # along each colour
BLUR = 0.8  # bins
SURE = 0.97  # share of one side in a colour from which it decides
HOLE = 0.15  # share of the person below which many pixels side by side are background
DARK = 64  # level up to which hair and what lies behind it look alike
DENSE = 2e-4  # of all pixels of a side, per bin, from which its colour is known
OVERLAP = 0.1  # of the person that may look like background; more, and colours cannot tell the two apart
CORE = 0.006  # of the crop's side: what is decided lies this far inside pixels of one kind
LEAST = 0.001  # of the crop's area: smaller specks of background on the person are part of it
RIM = 0.3  # share of a hole that must lie near the outline
DEEP = 0.05  # of the crop's side, depth in the person from which its colours are surely its own
LEAST_DOUBT = 0.1  # in the segmentation


def decided(
    known: NDArray[np.float64],
    image: NDArray[np.uint8],
    rough: NDArray[np.float32],
    sure: NDArray[np.bool_],
    inside: NDArray[np.float32],
) -> NDArray[np.float64]:
    """A trimap [S,S] with what colours decide in it; the same where person and background share theirs.

    Args:
        known: the trimap: 0 background, 0.5 unknown, 1 person.
        image: [S,S,3] sRGB.
        rough: [S,S] the segmentation that it was made from, in [0,1].
        sure: [S,S] pixels surely of the person, whatever their colour.
        inside: [S,S] how far each pixel lies in the photo.
    """
    from scipy import ndimage

    size, photo = len(known), inside > 0.99
    place = bins(image)
    person, background = known == 1, (known == 0) & photo
    if not (person & photo).any() or not background.any():
        return known
    share, seen = likeness(place, person & photo, background)
    foreign = (share < 1 - SURE) & seen
    if (foreign & person & photo).sum() > OVERLAP * (person & photo).sum():
        return known
    # Without what looks like background, the person's colours are known better; deep inside they are surest.
    share, seen = likeness(place, person & photo & ~foreign, background)
    share = ndimage.median_filter(share, 3)
    deep = ndimage.distance_transform_edt(person | ~photo) > DEEP * size
    inner = ndimage.median_filter(likeness(place, deep & photo | sure, background)[0], 3)
    # The segmentation is a witness too.
    doubt = np.clip(rough, LEAST_DOUBT, 1 - LEAST_DOUBT)
    odds = share * doubt / (share * doubt + (1 - share) * (1 - doubt))
    reach = max(1, round(CORE * size))
    result = known.copy()
    open_ = (known == 0.5) & photo
    result[open_ & seen & (odds < 1 - SURE)] = 0.0
    result[open_ & ndimage.binary_erosion((odds > SURE) & seen | person, iterations=reach)] = 1.0

    like_background = (inner < HOLE) & seen & ~sure & (image.max(-1) > DARK)
    holes = ndimage.binary_opening(like_background & person, iterations=reach)
    parts, count = ndimage.label(holes)
    area = np.bincount(parts.ravel(), minlength=count + 1)
    # Background shows where the outline runs in towards it, not in the midst of the person.
    near = ndimage.binary_dilation(~person, iterations=6 * reach)
    rim = np.bincount(parts[near], minlength=count + 1) > RIM * area
    holes = ((area >= LEAST * size**2) & rim)[parts] & (parts > 0)
    # The segmentation knows nothing of the photo's very edge, where it is continued.
    margin = photo & ndimage.binary_dilation(~photo, iterations=5 * reach)
    holes |= margin & ndimage.binary_opening(like_background & person)
    result[ndimage.binary_dilation(holes, iterations=3 * reach) & person & ~sure] = 0.5
    bays = holes | open_ & like_background & ndimage.binary_dilation(holes, iterations=8 * reach)
    result[ndimage.binary_erosion(bays | ~photo, iterations=reach) & photo] = 0.0
    return result


def bins(image: NDArray[np.uint8]) -> Bins:
    """The histogram's bin [S,S] of red, green and blue of each pixel of an image [S,S,3]."""
    red, green, blue = (image.astype(np.int64) * BINS // 256).transpose(2, 0, 1)
    return red, green, blue


def likeness(
    place: Bins, one: NDArray[np.bool_], other: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """How far pixels [S,S] look like the first set rather than the second, in [0,1], and whether any has their colour.

    Args:
        place: from `bins`.
        one: bool [S,S]
        other: bool [S,S]
    """
    from scipy import ndimage

    shares = []
    for chosen in (one, other):
        table = np.zeros((BINS,) * 3)
        np.add.at(table, tuple(axis[chosen] for axis in place), 1.0 / max(1, chosen.sum()))
        shares.append(ndimage.gaussian_filter(table, BLUR)[place])
    first, second = shares
    return first / (first + second + 1e-12), np.maximum(first, second) > DENSE
