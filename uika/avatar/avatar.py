"""The avatar: canonical Gaussians bound to a head model, and the file it is kept in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from uika.errors import UikaError
from uika.head import (
    Binding,
    HeadModel,
    HeadParameters,
    pose_gaussians,
    pose_vertices,
    shaped_vertices,
    skin_points,
)
from uika.head.light import COUNT
from uika.io.files import write_tensors

Skinning = Literal["surface", "released"]
SKINNINGS: tuple[Skinning, ...] = ("surface", "released")
FORMAT = "uika-avatar"
VERSION = "1"


class AvatarError(UikaError):
    """An avatar, or its file, that cannot be used; the message says which and what to do."""


@dataclass(frozen=True, eq=False)
class Avatar:
    """M Gaussians on the neutral, unposed head of one person; tensors are float32 on the CPU unless noted.

    The canonical surface is the head with this identity and static offset, zero pose and expression.
    """

    head_id: str
    identity: Tensor  # [K] standard deviations
    static_offset: Tensor  # [V,3] metres, added to the head's template (hair and clothes, mostly)
    means: Tensor  # [M,3] metres
    quats: Tensor  # [M,4] wxyz
    scales: Tensor  # [M,3] metres, standard deviations
    opacities: Tensor  # [M] in [0,1]
    colors: Tensor  # [M,3] sRGB in [0,1]
    triangle: Tensor  # [M] int64, triangle that carries each Gaussian
    barycentric: Tensor  # [M,3] its surface point
    provenance: Mapping[str, str] = field(default_factory=dict)
    skinning: Skinning = "surface"  # how it is moved, see `pose`
    light: Tensor | None = None  # [9,3] that the colours are kept under, see `uika.head.light`; None if unknown
    bust_triangle: int | None = None  # the first triangle of the head's bust, from which on Gaussians lie on it

    def __post_init__(self) -> None:
        """Check shapes, types and values.

        Raises:
            AvatarError: a tensor does not fit; the message names it.
        """
        count, vertices = self.means.shape[:1].numel(), self.static_offset.shape[:1].numel()
        shapes: dict[str, tuple[int, ...]] = {
            "identity": (self.identity.numel(),),
            "static_offset": (vertices, 3),
            "means": (count, 3),
            "quats": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
            "colors": (count, 3),
            "triangle": (count,),
            "barycentric": (count, 3),
            "light": (COUNT, 3),
        }
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            if tensor is None and name in _OPTIONAL:
                continue
            dtype = torch.int64 if name == "triangle" else torch.float32
            if tuple(tensor.shape) != shape or tensor.dtype != dtype:
                raise AvatarError(
                    f"avatar tensor '{name}' is {tensor.dtype} {list(tensor.shape)}, not {dtype} {list(shape)}"
                )
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise AvatarError(f"avatar tensor '{name}' holds values that are not finite")
        if self.skinning not in SKINNINGS:
            raise AvatarError(f"avatar is moved by '{self.skinning}', which must be one of {', '.join(SKINNINGS)}")
        if count == 0:
            raise AvatarError("avatar has no Gaussians")
        if bool((self.scales < 0).any()) or bool((self.triangle < 0).any()):
            raise AvatarError("avatar tensors 'scales' and 'triangle' must not hold negative values")
        if self.bust_triangle is not None and self.bust_triangle < 0:
            raise AvatarError("avatar entry 'bust_triangle' must not be negative")
        if bool((self.opacities < 0).any()) or bool((self.opacities > 1).any()):
            raise AvatarError("avatar tensor 'opacities' must lie between 0 and 1")

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.means)

    @property
    def on_bust(self) -> Tensor:
        """Which Gaussians [M] lie on the bust rather than on the head."""
        if self.bust_triangle is None:
            return torch.zeros(len(self), dtype=torch.bool)
        return self.triangle >= self.bust_triangle

    def save(self, path: str | Path) -> None:
        """Write a safetensors file; it appears under its name only when it is complete."""
        tensors = {name: value.contiguous() for name in _TENSORS if (value := getattr(self, name)) is not None}
        metadata = {
            "format": FORMAT,
            "version": VERSION,
            "head_id": self.head_id,
            "provenance": json.dumps(dict(self.provenance), sort_keys=True),
            "skinning": self.skinning,
        }
        if self.bust_triangle is not None:
            metadata["bust_triangle"] = str(self.bust_triangle)
        write_tensors(path, tensors, metadata)

    @staticmethod
    def load(path: str | Path) -> Avatar:
        """Read a file written by `save`.

        Raises:
            AvatarError: no such file, not an avatar, another format version, truncated, or with wrong content; one
                sentence that names the file.
        """
        source = Path(path)
        if not source.is_file():
            reason = "is a directory, not an avatar file" if source.is_dir() else "no such avatar file"
            raise AvatarError(f"{source}: {reason}; `uika reconstruct` makes one from photos")
        parts = _read(source)
        try:
            return Avatar(**parts)
        except AvatarError as error:
            raise AvatarError(f"{source}: {error}") from error

    def check_head(self, head: HeadModel) -> None:
        """Make sure that `head` is the head model that this avatar was made for.

        Raises:
            AvatarError: it is another one.
        """
        alone = head.without_bust
        if self.head_id == alone.id and len(self.static_offset) == len(alone.template):
            head = alone  # made for this head before it had a bust, which stays without Gaussians
        if head.id != self.head_id:
            raise AvatarError(
                f"the avatar was made for the head model '{self.head_id}', but '{head.id}' is loaded; "
                "set UIKA_HEAD to its file or make the avatar again"
            )
        for name, own, other in (
            ("identity coefficients", len(self.identity), len(head.identity_basis)),
            ("vertices", len(self.static_offset), len(head.template)),
        ):
            if own != other:
                raise AvatarError(f"the avatar has {own} {name}, but the head model '{head.id}' has {other}")
        if int(self.triangle.max()) >= len(head.faces):
            raise AvatarError(f"the avatar is bound to triangles that the head model '{head.id}' does not have")

    def canonical_vertices(self, head: HeadModel) -> Tensor:
        """The mesh [V,3] in metres that the Gaussians were placed on."""
        self.check_head(head)
        neutral = HeadParameters.zeros(head, dtype=head.template.dtype).replace(identity=self.identity)
        return shaped_vertices(head, neutral, self.static_offset)

    def pose(
        self,
        params: HeadParameters,
        head: HeadModel,
        canonical: Tensor | None = None,
        skinning: Skinning | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Move the Gaussians with the head.

        Args:
            params: expression and pose, batch [...]; the identity in it is ignored, the avatar keeps its own.
            head: the head model that the avatar was made for.
            canonical: [V,3] the result of `canonical_vertices`, to save time over many frames.
            skinning: "surface" turns and scales each Gaussian with the surface it lies on; "released" skins centres
                only and keeps rotations and scales, as the authors' released model does; None is the avatar's own.

        Returns:
            Means [...,M,3], quats [...,M,4] and scales [...,M,3].

        Raises:
            AvatarError: the head model is another one.
        """
        if (skinning or self.skinning) == "released":
            own = params.replace(identity=self.identity)
            means = skin_points(self.means, head, own, Binding(0, self.triangle, self.triangle, self.barycentric))
            lead = means.shape[:-2]
            return means, self.quats.expand(*lead, -1, -1), self.scales.expand(*lead, -1, -1)
        rest = self.canonical_vertices(head) if canonical is None else canonical
        posed = pose_vertices(head, params.replace(identity=self.identity), self.static_offset)
        return pose_gaussians(
            self.means, self.quats, self.scales, rest, posed, head.faces, self.triangle, self.barycentric
        )


_OPTIONAL = {"light"}  # files of earlier versions lack them
_TENSORS = tuple(f.name for f in fields(Avatar) if f.name not in ("head_id", "provenance", "skinning", "bust_triangle"))


def _read(path: Path) -> dict[str, Any]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise AvatarError(f"{path}: is not an avatar file; `uika reconstruct` makes one from photos")
            if metadata.get("version") != VERSION:
                found = metadata.get("version", "unknown")
                raise AvatarError(
                    f"{path}: is of avatar format version {found}, but this program reads version {VERSION}; "
                    "make the avatar again"
                )
            names = set(file.keys())
            if names | _OPTIONAL != set(_TENSORS):
                odd = ", ".join(sorted((names | _OPTIONAL) ^ set(_TENSORS))[:5])
                raise AvatarError(f"{path}: has missing or unknown tensors ({odd}); make the avatar again")
            provenance = json.loads(metadata["provenance"])
            if not isinstance(provenance, dict):
                raise AvatarError(f"{path}: has an unreadable provenance entry; make the avatar again")
            tensors = {name: file.get_tensor(name) for name in names}
            return {
                "head_id": metadata["head_id"],
                "provenance": {str(key): str(value) for key, value in provenance.items()},
                "skinning": metadata.get("skinning", "surface"),
                "bust_triangle": int(metadata["bust_triangle"]) if "bust_triangle" in metadata else None,
                **tensors,
            }
    except SafetensorError as error:
        raise AvatarError(f"{path}: is truncated, damaged or not an avatar file ({error})") from error
    except AvatarError:
        raise
    except (KeyError, ValueError, RecursionError) as error:
        raise AvatarError(f"{path}: has an incomplete header ({error}); make the avatar again") from error
