"""The parametric head: its data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from uika.head.bust import TORSO, Bust

JOINT_NAMES = ("root", "neck", "jaw", "left_eye", "right_eye")
JOINT_PARENTS = (-1, 0, 1, 1, 1)


class HeadError(ValueError):
    """A head file or a head's arrays cannot be used; the message names the file and the array."""


@dataclass(frozen=True, eq=False)
class HeadModel:
    """A head with linear identity and expression bases and linear-blend skinning.

    Head space is in metres with Y up; the face looks along +Z and +X is the subject's left.
    Sizes: V vertices, F triangles, T texture vertices, K identity modes, E expressions, L landmarks.
    Floating tensors are float32 and integer tensors int64 unless `to` changed them.
    """

    id: str
    template: Tensor  # [V,3] metres
    identity_basis: Tensor  # [K,V,3] metres per standard deviation
    expression_basis: Tensor  # [E,V,3] metres at full activation
    expression_names: tuple[str, ...]  # E names
    faces: Tensor  # [F,3] vertex ids, counter-clockwise seen from outside
    uvs: Tensor  # [T,2] in [0,1], v up as in OBJ files; u in [1,2] on the bust
    uv_faces: Tensor  # [F,3] ids into uvs
    joints: Tensor  # [5,3] rest joints in the order of JOINT_NAMES
    joint_identity: Tensor  # [K,5,3]
    joint_expression: Tensor  # [E,5,3]
    lbs_weights: Tensor  # [V,5], rows sum to one
    pose_basis: Tensor | None  # [36,V,3] pose correctives, or None
    masks: Mapping[str, Tensor]  # name -> [V] weight in [0,1]
    landmark_faces: Tensor  # [L] triangle of each embedded landmark
    landmark_barycentrics: Tensor  # [L,3]
    landmark_ids: Tensor  # [L] index in the 478-point face mesh
    landmark_weights: Tensor  # [L] trust in (0,1]
    bust: Bust | None = None  # where the bust begins, if the head has one

    def __post_init__(self) -> None:
        """Check that the arrays fit together.

        Raises:
            HeadError: a shape or an index does not fit.
        """
        V, F, L = len(self.template), len(self.faces), len(self.landmark_faces)
        K, E = len(self.identity_basis), len(self.expression_names)
        expected = {
            "template": (V, 3),
            "identity_basis": (K, V, 3),
            "expression_basis": (E, V, 3),
            "faces": (F, 3),
            "uvs": (len(self.uvs), 2),
            "uv_faces": (F, 3),
            "joints": (5, 3),
            "joint_identity": (K, 5, 3),
            "joint_expression": (E, 5, 3),
            "lbs_weights": (V, 5),
            "landmark_faces": (L,),
            "landmark_barycentrics": (L, 3),
            "landmark_ids": (L,),
            "landmark_weights": (L,),
        }
        if self.pose_basis is not None:
            expected["pose_basis"] = (36, V, 3)
        for name, shape in expected.items():
            check_shape(name, getattr(self, name), shape)
        for name, mask in self.masks.items():
            check_shape(f"mask_{name}", mask, (V,))
        _check_indices("faces", self.faces, V)
        _check_indices("uv_faces", self.uv_faces, len(self.uvs))
        _check_indices("landmark_faces", self.landmark_faces, F)
        if self.bust is not None:
            check_shape("bust_modes", self.bust.modes, (len(self.bust.modes), V - self.bust.vertex, 3))
            _check_indices("landmark_faces", self.landmark_faces, self.bust.face)

    @cached_property
    def without_bust(self) -> HeadModel:
        """The head alone: the same vertices, triangles and modes as far as they go."""
        if self.bust is None:
            return self
        v, f, t = self.bust.vertex, self.bust.face, self.bust.uv
        return replace(
            self,
            id=self.bust.head_id,
            template=self.template[:v],
            identity_basis=self.identity_basis[:, :v].contiguous(),
            expression_basis=self.expression_basis[:, :v].contiguous(),
            faces=self.faces[:f],
            uvs=self.uvs[:t],
            uv_faces=self.uv_faces[:f],
            lbs_weights=self.lbs_weights[:v],
            pose_basis=None if self.pose_basis is None else self.pose_basis[:, :v].contiguous(),
            masks={name: mask[:v] for name, mask in self.masks.items() if name != TORSO},
            bust=None,
        )

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> HeadModel:
        """Return a copy whose floating tensors have `dtype` and whose tensors all lie on `device`."""

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=dtype if tensor.is_floating_point() else None)

        changed = {f.name: move(v) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        masks = {name: move(mask) for name, mask in self.masks.items()}
        bust = None if self.bust is None else replace(self.bust, modes=move(self.bust.modes))
        return replace(self, masks=masks, bust=bust, **changed)  # type: ignore[arg-type]

    def landmarks(self, vertices: Tensor) -> Tensor:
        """Embedded landmarks [...,L,3] (or [...,L,2]) of a mesh [...,V,3] with this head's topology."""
        corners = vertices[..., self.faces[self.landmark_faces], :]
        return (corners * self.landmark_barycentrics[:, :, None].to(vertices.dtype)).sum(-2)


def check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape or with values that are not finite."""
    if tuple(tensor.shape) != shape:
        raise HeadError(f"array '{name}' has shape {tuple(tensor.shape)} where {shape} is needed")
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        raise HeadError(f"array '{name}' holds values that are not finite")


def _check_indices(name: str, indices: Tensor, count: int) -> None:
    if indices.numel() and (int(indices.min()) < 0 or int(indices.max()) >= count):
        raise HeadError(f"array '{name}' points outside 0..{count - 1}")
