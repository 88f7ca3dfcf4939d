"""One head from a growing set of photos: each new photo costs what is new about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from uika.canonical.surface import SurfaceTexels
from uika.model.gaussians import CanonicalGaussians
from uika.model.observation import Observation, observe, together
from uika.model.reconstructor import Reconstructor
from uika.model.transformer import ContextMemory
from uika.model.view_features import Keep, ViewFeatures
from uika.uv import Sums


class Session:
    """Photos of one head added one after the other, their features and contexts kept.

    `add` encodes the new photos alone and lets them and the UV tokens read the earlier photos, whose own contexts stay
    what they were: an approximation that ends with `refresh`, which runs the transformer over everything again.
    """

    def __init__(
        self,
        model: Reconstructor,
        texel: Tensor,
        surface: SurfaceTexels,
        keep: Keep = "foreground",
        prior: Callable[[Sums], Tensor] | None = None,
        *,
        growing: bool = True,
    ) -> None:
        """Arguments as in `Reconstructor.forward`; the surface belongs to one head, its batch dimension is 1.

        `prior` gives the surface's prior anew from the sums [1,1,C,S,S] of all photos. `growing` keeps the contexts of
        the transformer, which takes memory; without it every photo passes the transformer at every step.
        """
        self.model = model
        self.prior = prior
        self.texel = texel
        self.surface = surface
        self.keep: Keep = keep
        self._views: list[ViewFeatures] = []
        self._growing = growing
        self._memory = ContextMemory() if growing else None
        self._sums: list[Sums] = []

    def __len__(self) -> int:
        """The number of photos."""
        return len(self._views)

    @torch.no_grad()
    def add(
        self, images: Tensor, masks: Tensor, pixel_uv: Tensor, pixel_weight: Tensor | None = None
    ) -> CanonicalGaussians:
        """The head from all photos so far and V new ones; shapes [1,V,...] as in `Reconstructor.forward`.

        Raises ValueError for shapes that do not fit.
        """
        self.model.check(images, self.texel, self.surface)
        if len(images) != 1:
            raise ValueError(f"images must be [1,V,3,H,W], the photos of one head, got {list(images.shape)}")
        new = self.model.encode(images, masks, pixel_uv, pixel_weight, self.keep)[0]
        reused = len(self)
        self._views += new
        return self._decode(reused, len(new) if self._growing else len(self))

    @torch.no_grad()
    def observe(
        self, images: Tensor, masks: Tensor, pixel_uv: Tensor, pixel_weight: Tensor | None = None
    ) -> Observation:
        """What all photos so far and V new ones show, without learned weights; arguments as in `add`."""
        self._sums += self.model.sums(images, masks, pixel_uv, pixel_weight)
        return observe(self.model.config.uv, self._sums, self.texel, self._completed(self._sums))

    @torch.no_grad()
    def refresh(self) -> CanonicalGaussians:
        """The head as if all photos had come at once.

        Raises ValueError when there are none.
        """
        if not self._views:
            raise ValueError("the session has no photos yet: add some first")
        self._memory = ContextMemory() if self._growing else None
        return self._decode(len(self), len(self))

    def _decode(self, reused: int, newcomers: int) -> CanonicalGaussians:
        surface = self._completed([view.sums for view in self._views])
        return self.model.decode([self._views], self.texel, surface, self.keep, reused, self._memory, newcomers)

    def _completed(self, sums: Sequence[Sums]) -> SurfaceTexels:
        """The surface with the prior that these photos suggest."""
        return self.surface if self.prior is None else replace(self.surface, prior=self.prior(together(sums)))
