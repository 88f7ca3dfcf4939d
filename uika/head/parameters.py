"""What moves and shapes a head: identity, expression and pose parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from dataclasses import replace as dataclass_replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.head.model import HeadModel


@dataclass(frozen=True, eq=False)
class HeadParameters:
    """Parameters of one head or of a batch of heads; leading batch dimensions [...] are shared or broadcast.

    Rotations are axis-angle vectors in radians, applied root, neck, then jaw and eyes.
    """

    identity: Tensor  # [...,K] standard deviations
    expression: Tensor  # [...,E] activations
    rotation: Tensor  # [...,3] of the root
    neck: Tensor  # [...,3]
    jaw: Tensor  # [...,3]
    eyes: Tensor  # [...,6] left, then right
    translation: Tensor  # [...,3] metres

    def __post_init__(self) -> None:
        """Check the trailing sizes that do not depend on the head.

        Raises:
            ValueError: a pose field has the wrong last dimension.
        """
        for name, size in (("rotation", 3), ("neck", 3), ("jaw", 3), ("eyes", 6), ("translation", 3)):
            tensor = getattr(self, name)
            if tensor.ndim == 0 or tensor.shape[-1] != size:
                raise ValueError(f"head parameter '{name}' has shape {tuple(tensor.shape)}; it must end in {size}")

    @staticmethod
    def zeros(head: HeadModel, batch: Sequence[int] | int = (), dtype: torch.dtype = torch.float32) -> HeadParameters:
        """The mean, neutral head in rest pose, with batch dimensions `batch`."""
        lead = (batch,) if isinstance(batch, int) else tuple(batch)

        def zero(size: int) -> Tensor:
            return torch.zeros(*lead, size, dtype=dtype, device=head.template.device)

        return HeadParameters(
            identity=zero(len(head.identity_basis)),
            expression=zero(len(head.expression_basis)),
            rotation=zero(3),
            neck=zero(3),
            jaw=zero(3),
            eyes=zero(6),
            translation=zero(3),
        )

    @property
    def batch_shape(self) -> torch.Size:
        """The broadcast batch dimensions of all fields."""
        # numpy's, as torch's loads its compiler.
        return torch.Size(np.broadcast_shapes(*(getattr(self, f.name).shape[:-1] for f in fields(self))))

    def replace(self, **changes: Tensor) -> HeadParameters:
        """A copy with the named fields exchanged."""
        return dataclass_replace(self, **changes)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> HeadParameters:
        """A copy in another type or on another device."""
        return HeadParameters(**{f.name: getattr(self, f.name).to(device=device, dtype=dtype) for f in fields(self)})

    def detach(self) -> HeadParameters:
        """A copy cut off from the gradient graph."""
        return HeadParameters(**{f.name: getattr(self, f.name).detach() for f in fields(self)})

    def __getitem__(self, index: Any) -> HeadParameters:
        """Index the first batch dimension; fields without batch dimensions are kept whole."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return HeadParameters(**{name: value[index] if value.ndim > 1 else value for name, value in values.items()})

    @staticmethod
    def stack(items: Sequence[HeadParameters]) -> HeadParameters:
        """Join equally shaped parameters along a new first batch dimension."""
        if not items:
            raise ValueError("HeadParameters.stack needs at least one item")
        names = [f.name for f in fields(HeadParameters)]
        return HeadParameters(**{name: torch.stack([getattr(item, name) for item in items]) for name in names})
