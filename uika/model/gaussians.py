"""What the model is given about the head surface, and what it returns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from torch import Tensor


@dataclass(frozen=True)
class SurfaceTexels:
    """The canonical head surface at the M valid texels of the atlas; B is the batch size or 1.

    points  [B,M,3] metres
    quats   [B,M,4] wxyz rotation of the surface frame, local z along the outward normal
    scales  [B,M,3] metres: standard deviations that close the surface, two tangent sizes and a thin normal one
    mirror  [S,S] int64 row-major index of each texel's counterpart on the other half of the face, -1 where there is
            none; None if unknown
    regions [S,S] int64 labels of parts whose colours do not mix (skin, eyeballs, teeth), or None
    lift    [1,S,S] metres by which hair stands off the bald head, 0 elsewhere, or None
    shape   [3,S,S] metres from the mean bald head to the surface, 0 elsewhere, or None
    prior   [3,S,S] colours for texels that neither a photo nor its mirror image shows, NaN where there is none, or None
    """

    points: Tensor
    quats: Tensor
    scales: Tensor
    mirror: Tensor | None = None
    regions: Tensor | None = None
    prior: Tensor | None = None
    lift: Tensor | None = None
    shape: Tensor | None = None

    def rows(self, first: int, last: int) -> SurfaceTexels:
        """The texels from `first` to before `last`; the maps stay whole."""
        points, quats, scales = (value[:, first:last] for value in (self.points, self.quats, self.scales))
        return replace(self, points=points, quats=quats, scales=scales)


@dataclass(frozen=True)
class CanonicalGaussians:
    """One Gaussian per valid texel, in the order of `texel`, in the canonical space of the surface.

    Unpacks as means, quats, scales, opacities, colors.

    means [B,M,3] metres, quats [B,M,4] wxyz unit, scales [B,M,3] metres, opacities [B,M], colors [B,M,3] in [0,1],
    offsets [B,M,3] metres (means minus surface points), fusion_weight [B,M] share of the predicted colour,
    aggregate [B,3,S,S] and confidence [B,1,S,S] the UV observation the colours start from,
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
