"""What the model is given about the head surface, and what it returns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class CanonicalGaussians:
    """One Gaussian per valid texel, in the order of `texel`, in the canonical space of the surface.

    Unpacks as means, quats, scales, opacities, colors.

    means [B,M,3] metres, quats [B,M,4] wxyz unit, scales [B,M,3] metres, opacities [B,M], colors [B,M,3] in [0,1],
    offsets [B,M,3] metres (means minus surface points), fusion_weight [B,M] share of the predicted colour,
    aggregate [B,3,S,S] and confidence [B,1,S,S] the UV observation the colours start from, known [B,1,S,S] how far it
    is what the photos show at that very place,
    report: counts of what was skipped or filled (see `Reconstructor.forward`).
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    offsets: Tensor
    fusion_weight: Tensor
    aggregate: Tensor
    confidence: Tensor
    known: Tensor
    report: Mapping[str, int]

    def __iter__(self) -> Iterator[Tensor]:
        """The five tensors that make the Gaussians."""
        return iter((self.means, self.quats, self.scales, self.opacities, self.colors))

    def __getitem__(self, name: str) -> Tensor:
        """A field by its name."""
        if name not in _FIELDS:
            raise KeyError(name)
        return getattr(self, name)


_FIELDS = tuple(name for name in CanonicalGaussians.__annotations__ if name != "report")
