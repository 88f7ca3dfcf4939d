"""Soft vertex masks of the baked head, from its parts, region probes and landmarks."""

import numpy as np
from matplotlib.path import Path as Outline

from .topology import PARTS, Head

# Outline of the face in the 478-point face mesh.
FACE_OVAL = (
    10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377,
    152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109,
)  # fmt: skip


def _smooth(values: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0)
    degree = np.bincount(edges.ravel(), minlength=len(values))
    for _ in range(rounds):
        total = np.zeros_like(values)
        np.add.at(total, edges[:, 0], values[edges[:, 1]])
        np.add.at(total, edges[:, 1], values[edges[:, 0]])
        values = 0.5 * values + 0.5 * total / degree.clip(min=1)
    return values


def build_masks(
    head: Head, template: np.ndarray, landmark_ids: np.ndarray, landmark_points: np.ndarray
) -> dict[str, np.ndarray]:
    """Weights in [0,1] per vertex: face, lips, eyes, ears, scalp, neck, mouth_inner, eyeballs."""

    def of_parts(*names: str) -> np.ndarray:
        mask = np.zeros(len(template))
        for name in names:
            mask[np.unique(head.faces[head.part == PARTS.index(name)])] = 1.0
        return mask

    def probe(name: str, share: float) -> np.ndarray:
        return np.clip(head.probes[name] / (share * head.probes[name].max()), 0, 1) * skin

    skin = np.clip(of_parts("skin") + of_parts("neck"), 0, 1)
    at = {int(i): p for i, p in zip(landmark_ids, landmark_points, strict=True)}
    oval = np.array([at[i] for i in FACE_OVAL if i in at])
    centre = np.array([0.0, oval[:, 1].mean(), 0.0])
    # Seen from a point behind the face, a vertex belongs to the face when its direction lies inside the outline.
    eye_point = centre - [0, 0, 0.10]
    outline = (oval - eye_point)[:, :2] / (oval - eye_point)[:, 2:]
    rays = (template - eye_point)[:, :2] / np.maximum(template - eye_point, 1e-3)[:, 2:]
    inside = Outline(outline).contains_points(rays)
    ears = np.clip(probe("ears", 1.0) / 0.3 - 1.0, 0, 1)
    face = _smooth(1.0 * (inside & (template[:, 2] > 0) & (skin > 0) & (ears < 0.3)), head.faces, 2) * skin
    chin = at[152][1]
    ear_low = template[ears > 0.8, 1].min()
    neck_line = np.interp(template[:, 2], [-0.08, 0.02, 0.07], [ear_low - 0.02, chin, chin - 0.01])
    neck = _smooth(1.0 * (template[:, 1] < neck_line), head.faces, 3) * skin * (1 - face)
    brow = max(at[i][1] for i in (105, 334))
    hairline = np.interp(template[:, 2], [-0.02, 0.04, 0.09], [ear_low - 0.01, brow - 0.01, brow + 0.045])
    scalp = 1.0 * (template[:, 1] > hairline) * (skin > 0)
    scalp = np.maximum(scalp, (template[:, 2] < -0.015) * (template[:, 1] > ear_low - 0.02) * (skin > 0))
    scalp = _smooth(scalp, head.faces, 4) * skin * (1 - ears)
    eyes = np.clip(np.linalg.norm(head.actions[[8, 9]], axis=-1).sum(0) / 0.002, 0, 1) * skin
    return {
        "face": face,
        "lips": probe("lips", 0.35),
        "eyes": eyes,
        "ears": ears,
        "scalp": scalp,
        "neck": neck,
        "mouth_inner": of_parts("mouth", "tongue", "teeth_upper", "teeth_lower") * (1 - skin),
        "teeth": of_parts("teeth_upper", "teeth_lower"),
        "eyeballs": of_parts("eyes"),
    }
