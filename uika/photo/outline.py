"""Face-mesh landmark numbers of outlines, and the region inside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FOREHEAD, CHIN = 10, 152
MOUTH_CORNERS = (61, 291)
# The face's outline from the subject's right ear down along the jaw to the left ear, then back over the forehead.
JAW = (127, 234, 93, 132, 58, 172, 136, 150, 149, 176, 148, 152, 377, 400, 378, 379, 365, 397, 288, 361, 323, 454, 356)
BROW = (389, 251, 284, 332, 297, 338, 10, 109, 67, 103, 54, 21, 162)
OVAL = (*JAW, *BROW)


def face_frame(landmarks: NDArray[np.float64], points: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Distance [...] across the face and height [...] above the chin of points [...,2], both in face heights.

    A face height is the distance from chin to forehead line in the landmarks [478,2]; the frame turns with the face.
    """
    up = landmarks[FOREHEAD] - landmarks[CHIN]
    offset = (points - landmarks[CHIN]) / (up @ up)
    return offset @ np.array([-up[1], up[0]]), offset @ up


def polygon(points: NDArray[np.float64], size: int) -> NDArray[np.bool_]:
    """Pixels [size,size] inside a polygon of pixel coordinates [P,2] (pixel centres at +0.5)."""
    from PIL import Image, ImageDraw

    canvas = Image.new("1", (size, size))
    ImageDraw.Draw(canvas).polygon([(float(x) - 0.5, float(y) - 0.5) for x, y in points], fill=1)
    return np.array(canvas)
