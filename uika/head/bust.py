"""The bust below a head: neck, shoulders, upper chest and back, appended to the head's own arrays.

A head with a bust begins with the vertices, triangles, texture vertices and masks of the head alone, unchanged, so that
everything which looks at the head only can go on with `HeadModel.without_bust`. The bust lies in a second tile of the
atlas, u in [1,2].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

TORSO = "torso"  # name of the mask of the bust's vertices
FADE = (0.004, 0.03)  # metres above the cut that ends a bust, between which its picture becomes opaque
_FLAT = 1e-4  # metres by which the cut's vertices differ in height


@dataclass(frozen=True, eq=False)
class Bust:
    """Where a head's bust begins, and the shapes that it has besides those that follow the head's identity."""

    head_id: str  # of the head without it
    vertex: int  # its first vertex
    face: int  # its first triangle
    uv: int  # its first texture vertex
    modes: Tensor  # [J,B,3] metres per standard deviation, of its B vertices


class BustArrays(NamedTuple):
    """A bust to be hung on a head of V vertices, K identity modes and T texture vertices."""

    head_id: str  # of the head
    template: Tensor  # [B,3] metres
    faces: Tensor  # [F,3] vertices; those below V are the head's
    uvs: Tensor  # [U,2], u in [1,2]
    uv_faces: Tensor  # [F,3] into the U
    lbs_weights: Tensor  # [B,5]
    identity: Tensor  # [K,B,3] metres per standard deviation of the head's identity
    modes: Tensor  # [J,B,3]


def fade(height: Tensor) -> Tensor:
    """The share [...] of its opacity that what lies `height` [...] metres above the cut has."""
    return ((height - FADE[0]) / (FADE[1] - FADE[0])).clamp(0, 1)


def cut_rim(template: Tensor) -> Tensor:
    """Which vertices [V] of a head's template [V,3] lie on the cut that ends its bust."""
    height = template[:, 1]
    return height < height.min() + _FLAT


def above_cut(template: Tensor, canonical: Tensor, points: Tensor) -> Tensor:
    """How high [M] in metres points [M,3] lie above the cut of a head's mesh [V,3] with someone's shape."""
    return points[:, 1] - canonical[cut_rim(template), 1].median()


def pack_bust(bust: BustArrays, rank: int) -> dict[str, np.ndarray]:
    """The arrays of a bust's file: shapes as int16, what follows the identity as a product of `rank` columns."""
    u, s, vt = torch.linalg.svd(bust.identity.double().flatten(1), full_matrices=False)
    follow = (s[:rank, None] * vt[:rank]).unflatten(1, (-1, 3))
    arrays = {
        "head_id": np.array(bust.head_id),
        "template": bust.template.float().numpy(),
        "faces": bust.faces.to(torch.int32).numpy(),
        "uvs": bust.uvs.float().numpy(),
        "uv_faces": bust.uv_faces.to(torch.int32).numpy(),
        "lbs_weights": bust.lbs_weights.to(torch.float16).numpy(),
        "identity_mix": u[:, :rank].float().numpy(),
    }
    for name, shapes in (("identity", follow), ("modes", bust.modes.double())):
        scale = shapes.abs().amax((1, 2), keepdim=True).clamp_min(1e-30) / np.iinfo(np.int16).max
        arrays[f"{name}_q"] = (shapes / scale).round().to(torch.int16).numpy()
        arrays[f"{name}_scale"] = scale.flatten().float().numpy()
    return arrays


def unpack_bust(arrays: Mapping[str, np.ndarray]) -> BustArrays:
    """The bust of a file's arrays.

    Raises:
        KeyError: an array is missing.
        ValueError: an array's values cannot be used.
    """

    def real(name: str) -> Tensor:
        return torch.from_numpy(arrays[name].astype(np.float32))

    def whole(name: str) -> Tensor:
        return torch.from_numpy(arrays[name].astype(np.int64))

    def shapes(name: str) -> Tensor:
        return real(f"{name}_q") * real(f"{name}_scale")[:, None, None]

    weights = real("lbs_weights")
    return BustArrays(
        head_id=str(arrays["head_id"]),
        template=real("template"),
        faces=whole("faces"),
        uvs=real("uvs"),
        uv_faces=whole("uv_faces"),
        lbs_weights=weights / weights.sum(-1, keepdim=True),
        identity=torch.einsum("kr,rvc->kvc", real("identity_mix"), shapes("identity")),
        modes=shapes("modes"),
    )
