"""One non-overlapping atlas in [0,1]^2 (v up) that gives the face most of the texels."""

import numpy as np

from .topology import PARTS, Head

MARGIN = 0.006
# Target boxes (u0, u1, v0, v1), v up.
BOXES = {
    "skin": (0.0, 1.0, 0.16, 1.0),
    "mouth": (0.0, 0.17, 0.0, 0.15),
    "tongue": (0.18, 0.26, 0.0, 0.14),
    "eyes": (0.27, 0.50, 0.0, 0.11),
    "teeth_upper": (0.51, 0.69, 0.08, 0.15),
    "teeth_lower": (0.51, 0.69, 0.0, 0.07),
    "neck": (0.70, 1.0, 0.0, 0.15),
}
FACE_ZOOM = (0.72, 0.45)  # strength of the magnification of the face along u and v


def _fit(points: np.ndarray, box: tuple[float, float, float, float]) -> np.ndarray:
    low, high = points.min(0), points.max(0)
    u0, u1, v0, v1 = box
    start, size = np.array([u0, v0]) + MARGIN / 2, np.array([u1 - u0, v1 - v0]) - MARGIN
    return start + (points - low) / (high - low) * size


def _magnify(t: np.ndarray, centre: float, strength: float) -> np.ndarray:
    """Monotone map of [0,1] onto itself whose slope is 1 + strength near `centre` and lower away from it."""
    grid = np.linspace(0.0, 1.0, 2001)
    slope = 1.0 - strength + 2.0 * strength * np.exp(-0.5 * ((grid - centre) / 0.22) ** 2)
    rise = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]))])
    return np.interp(t, grid, rise / rise[-1])


def build_atlas(head: Head) -> np.ndarray:
    """UVs [T,2] of the packed atlas.

    Raises:
        ValueError: an island would be mirrored or folded by the packing.
    """
    uvs = np.zeros_like(head.uvs)
    for name, box in BOXES.items():
        ids = np.unique(head.uv_faces[head.part == PARTS.index(name)])
        points = head.uvs[ids]
        if name == "skin":
            # The island lies on its side, forehead to the left: turn it upright, then enlarge the face.
            points = _fit(np.stack([1.0 - points[:, 1], 1.0 - points[:, 0]], -1) * [-1.0, 1.0], (0, 1, 0, 1))
            face = head.uv_faces[head.part == PARTS.index(name)]
            nose = head.probes["nose"][head.faces[head.part == PARTS.index(name)]] > 0.003
            middle = _fit_like(points, ids, face[nose])
            points = np.stack([_magnify(points[:, k], middle[k], FACE_ZOOM[k]) for k in range(2)], -1)
        if name == "eyes":
            points = _split_eyes(points)
        uvs[ids] = _fit(points, box)
    corners = uvs[head.uv_faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    folded = int((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] <= 0).sum())
    if folded:
        raise ValueError(f"{folded} triangles of the atlas are mirrored or folded; check the boxes and the zoom")
    return uvs


def _fit_like(points: np.ndarray, ids: np.ndarray, corners: np.ndarray) -> np.ndarray:
    return points[np.searchsorted(ids, np.unique(corners))].mean(0)


def _split_eyes(points: np.ndarray) -> np.ndarray:
    """Move the two eye islands next to each other; they lie far apart in the source."""
    second = points[:, 0] > points[:, 0].mean()
    out = points.copy()
    width = np.ptp(points[~second, 0])
    out[second, 0] += points[~second, 0].max() + 0.1 * width - points[second, 0].min()
    return out
