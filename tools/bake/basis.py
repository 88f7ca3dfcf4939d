"""Identity modes, joints and skinning weights of the baked head."""

from dataclasses import dataclass

import numpy as np

from .topology import PARTS, Head

MODES = 100


@dataclass(frozen=True)
class Basis:
    """Head space: origin at the mean skull, metres; identity coefficients are N(0,1)."""

    template: np.ndarray  # [V,3]
    identity: np.ndarray  # [K,V,3] metres per sigma
    expression: np.ndarray  # [52,V,3]
    joints: np.ndarray  # [5,3]
    joint_identity: np.ndarray  # [K,5,3]
    weights: np.ndarray  # [V,5]
    energy: np.ndarray  # [K] share of the variance explained by the first k modes


def _five_joints(head: Head, bones: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Positions [S,5,3] and skinning weights [V,5] of root, neck, jaw, left eye, right eye."""
    index = {name: i for i, name in enumerate(bones)}
    pivots = ["neck01", "neck03", "jaw", "eye.L", "eye.R"]
    joints = head.identity_joints[:, [index[name] for name in pivots]]
    joints[:, 0:3, 0] = 0.0
    w = head.bone_weights
    jaw = w[:, index["jaw"] : index["levator02.L"]].sum(1)
    low = w[:, index["root"]] + w[:, index["neck01"]] + 0.6 * w[:, index["neck02"]] + 0.25 * w[:, index["neck03"]]
    eyeball = np.zeros(len(w), bool)
    eyeball[np.unique(head.faces[head.part == PARTS.index("eyes")])] = True
    weights = np.zeros((len(w), 5))
    weights[:, 0], weights[:, 2] = low, jaw
    weights[:, 1] = 1.0 - low - jaw
    left = head.neutral[:, 0] > 0
    weights[eyeball] = 0.0
    weights[eyeball & left, 3] = 1.0
    weights[eyeball & ~left, 4] = 1.0
    return joints, weights


def build_basis(head: Head, bones: list[str]) -> Basis:
    """PCA over centred heads of equal size: otherwise the first mode is size, which only a camera distance shows."""
    joints, weights = _five_joints(head, bones)
    skull = (weights[:, 1] > 0.99) & (head.bone_weights[:, bones.index("head")] > 0.5)
    centre = head.identities[:, skull].mean(1, keepdims=True)
    vertices, joints = head.identities - centre, joints - centre
    size = np.sqrt((vertices[:, skull] ** 2).sum((1, 2), keepdims=True) / skull.sum())
    scale = size.mean() / size
    vertices, joints = vertices * scale, joints * scale
    # Left-right symmetry of the sample makes the mean face straight even where the draws were not balanced.
    template = vertices.mean(0)
    rows = (vertices - template).reshape(len(vertices), -1)
    gram = rows @ rows.T
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1][:MODES]
    values, vectors = values[order], vectors[:, order]
    sigma = np.sqrt(values / (len(rows) - 1))
    modes = (rows.T @ vectors / np.sqrt(values)).T * sigma[:, None]
    scores = vectors * np.sqrt(len(rows) - 1)  # coefficients of unit variance
    mean_joints = joints.mean(0)
    joint_identity = np.einsum("sk,sjc->kjc", scores, joints - mean_joints) / (len(rows) - 1)
    return Basis(
        template=template,
        identity=modes.reshape(MODES, -1, 3),
        expression=head.actions * float(scale.mean()),
        joints=mean_joints,
        joint_identity=joint_identity,
        weights=weights,
        energy=np.cumsum(values) / (rows**2).sum(),
    )
