"""The head's share of a matte: face, ears and hair without neck, shoulders and clothes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uika.photo import matte
from uika.photo.crop import pixel_centres
from uika.photo.outline import JAW, OVAL, face_frame, polygon
from uika.photo.preparation import Photo

EAR_LOBES = (132, 361)
JAW_CORNERS = (172, 397)
# In face heights (forehead line to chin).
HAIR_DROP = 0.3  # hair beside the neck is kept down to this far below the chin
CUT = 0.04  # width of the soft cut under the jaw
HAIR_FROM, HAIR_TO = 0.2, 0.5  # the solution fades along hanging hair: what keeps half of it is all hair
FAINT = 0.05  # matte below which a pixel beside the neck counts as background


def head_matte(photo: Photo) -> Tensor:
    """Matte [S,S] float32 in [0,1] of the head alone: `photo.matte` cut below the jaw.

    Under the jaw the cut follows the jaw's outline. Beside it, from the ear lobes down, hair and clothes are told apart
    by closed-form matting, with everything higher known as head and the neck and everything well below the chin known
    as rest. Hair that hangs lower than that is lost.
    """
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
    known[(above > lobes) | polygon(points[list(OVAL)], size)] = 1.0
    image = (photo.original.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    share = (matte.solve(image, known) - HAIR_FROM) / (HAIR_TO - HAIR_FROM)
    return torch.minimum(photo.matte, torch.from_numpy(share.clip(0, 1)))
